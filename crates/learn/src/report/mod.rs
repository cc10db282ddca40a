//! One self-contained page a run, and the pictures in it.
