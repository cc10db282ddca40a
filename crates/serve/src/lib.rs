//! A policy behind openpi's websocket protocol, and any openpi server as a policy.
//!
//! The protocol is that of [openpi](https://github.com/Physical-Intelligence/openpi): binary messages of msgpack with numpy arrays
//! in them ([`wire`]). The server speaks first and says what it is; then each message of observations is answered with a chunk of
//! actions. An error is a text frame, after which the connection is closed with code 1011. openpi's own client talks to this
//! server, and [`RemotePolicy`] talks to openpi's.
//!
//! What is served is a [`Servable`]; [`open`] makes one of a checkpoint of this project's or of LeRobot's. The same seed and the
//! same observation get the same bytes, whatever else is asked at the same time: requests that wait are answered by one call
//! of the network, in which each has a random stream of its own.
//!
//! It knows no task and no simulator. It has no TLS: between machines, a proxy or a tunnel in front of it has.
//!
//! ```no_run
//! use e2h_serve::{Server, Settings, open};
//!
//! let server = Server::start(open("checkpoints/nut_assembly".as_ref())?, Settings::default())?;
//! println!("{} wants {} numbers of state", server.address(), server.inputs().state);
//! server.stop();
//! # Ok::<(), e2h_serve::Error>(())
//! ```
//!
//! # Requests
//!
//! | key | what |
//! |---|---|
//! | `observation/state`, `observation.state` or `state` | the state, (S) or (To, S) |
//! | `observation/images/CAM`, `observation.images.CAM`, `observation/CAM`, `CAM` | an image, uint8 (H, W, 3) or (To, H, W, 3); (3, H, W) where that alone fits |
//! | `observation/image`, `observation/wrist_image` | the first and the second camera, where no key with its own name is there |
//! | `seed` | a whole number: the same answer every time |
//! | `reset` | true: the connection's random stream begins anew |
//! | `random_stream` | the bytes of a ChaCha8 stream to draw from; the answer has it as far as it was used |
//!
//! Other keys, such as `prompt`, are passed over. Without a history the observation counts for every step of it. An answer has
//! `actions` (Ta, A), `server_timing` (`infer_ms`, `prev_total_ms`) and the `seed` it was made with.

mod client;
mod error;
mod inference;
mod metrics;
mod remote;
mod request;
mod servable;
mod server;
mod session;
mod token;
pub mod wire;

pub use client::{Client, ClientSettings};
pub use error::{Error, Result};
pub use remote::{Metadata, RemotePolicy, RemoteSettings};
pub use request::Request;
pub use servable::{Camera, Inputs, Seen, Servable, open, open_on};
pub use server::{Server, Settings};
pub use token::Token;
