//! `meta/tasks.parquet`: what was to be done, in words.

use super::feature::{Dtype, Feature};
use super::parquet_file::ParquetFile;
use super::parquet_writer::ParquetWriter;
use super::table::Column;
use crate::Result;
use crate::file::file_error;
use arrow_array::{ArrayRef, Int64Array, RecordBatch, StringArray};
use serde_json::json;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The column that pandas makes an index of.
const TEXT: &str = "__index_level_0__";

pub(crate) fn path(root: &Path) -> PathBuf {
    root.join("meta/tasks.parquet")
}

/// Tasks in the order of their index.
pub(crate) fn read(root: &Path) -> Result<Vec<String>> {
    let file = ParquetFile::open(&path(root))?;
    // LeRobot and older converters give the index column one name or the other.
    let name = if file.has(TEXT) { TEXT } else { "task" };
    let (index, text) = (Feature::scalar(Dtype::Int64), Feature::scalar(Dtype::String));
    let columns = file.read(&[("task_index", &index), (name, &text)], 0..file.rows())?;
    let [(_, Column::I64(index)), (_, Column::Text(tasks))] = &columns[..] else {
        return Err(file_error(&file.path, "columns", "an index and a text", "others"));
    };
    for (row, &found) in index.iter().enumerate() {
        // LeRobot looks a task up by its place, not by its index.
        if usize::try_from(found).ok() != Some(row) {
            let what = format!("column `task_index`, row {row}");
            return Err(file_error(&file.path, &what, row.to_string(), found.to_string()));
        }
    }
    Ok(tasks.clone())
}

pub(crate) fn write(root: &Path, tasks: &[String]) -> Result<()> {
    let path = path(root);
    // Without this entry in the schema pandas finds no index, and LeRobot's `item["task"]` is a number.
    let pandas = json!({
        "index_columns": [TEXT],
        "column_indexes": [{"name": null, "field_name": null, "pandas_type": "unicode", "numpy_type": "object",
            "metadata": {"encoding": "UTF-8"}}],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64",
                "metadata": null},
            {"name": null, "field_name": TEXT, "pandas_type": "unicode", "numpy_type": "object", "metadata": null},
        ],
        "creator": {"library": "e2h-data", "version": env!("CARGO_PKG_VERSION")},
        "pandas_version": "2.2.3",
    });
    let index = Int64Array::from_iter_values((0_i64..).take(tasks.len()));
    let columns: Vec<(&str, ArrayRef)> =
        vec![("task_index", Arc::new(index)), (TEXT, Arc::new(StringArray::from(tasks.to_vec())))];
    let bad = |e: arrow_schema::ArrowError| file_error(&path, "columns", "one length", e.to_string());
    let batch = RecordBatch::try_from_iter_with_nullable(columns.into_iter().map(|(n, c)| (n, c, true)))
        .map_err(bad)?;
    let metadata = HashMap::from([("pandas".to_owned(), pandas.to_string())]);
    let schema = Arc::new(batch.schema().as_ref().clone().with_metadata(metadata));
    let batch = batch.with_schema(schema.clone()).map_err(bad)?;
    let mut writer = ParquetWriter::create(&path, schema)?;
    writer.write(&batch)?;
    writer.finish()
}
