//! Datasets in the layout that LeRobot reads and writes: LeRobotDataset v3.0.
//!
//! Rows lie in Parquet files of many episodes, images as PNG inside them; `meta/` says where each episode lies and what its
//! numbers are like. [`Dataset`] reads such a folder, [`Writer`] makes or extends one, [`check`] and [`repair`] deal with
//! damage.
//! Columns have any name ([`Table`]); an [`e2h_core::Episode`] goes in and comes out whole, with all that is known of where
//! it comes from ([`Writer::push_episode`], [`Dataset::read_episode`]).
//!
//! # Source
//! LeRobot 0.4.4, format v3.0; checked against it by `tests/interop/run.sh`.

mod arrow;
mod check;
mod check_rows;
mod dataset;
mod episode;
mod episodes;
mod feature;
mod info;
mod layout;
mod limits;
mod mp4;
mod packing;
mod parquet_file;
mod parquet_source;
mod parquet_writer;
mod picture;
mod promises;
mod repair;
mod robot;
mod stats;
mod table;
mod tasks;
mod thrift;
mod video;
mod writer;

pub use check::{Fault, FaultKind, Report, check};
pub use dataset::Dataset;
pub use episode::{
    ACTION_NAMES, EXCURSION_NAMES, SOURCE_EXCURSION, SOURCE_FATE, SOURCE_FRAME, STATE_NAMES, features,
    features_of, from_table, source_columns, source_features, to_table,
};
pub use episodes::{EpisodeSpan, VideoSpan};
pub use feature::{DEFAULT_FEATURES, Dtype, Feature, Features, Skipped, VERSION};
pub use info::Info;
pub use layout::misfits;
pub use picture::{decode_image as decode_png, encode as encode_png};
pub use repair::{REMOVED, repair};
pub use robot::{ColumnSlice, RobotColumns, Rotation};
pub use stats::{FeatureStats, QUANTILES, Stats};
pub use table::{Column, Table};
pub use video::video_decoder;
pub use writer::Writer;

#[cfg(test)]
mod tests;
