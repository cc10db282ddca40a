//! Finds or fetches the pinned MuJoCo library and tells the linker where it is.
