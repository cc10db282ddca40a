//! Tests of the protocol, in one binary: each module says what it is about.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot be set up should fail")]

mod common; // a small policy, a server of it, and clients that know the protocol and nothing else
mod folders;
mod remote;
mod requests;
mod server;
mod wire;
