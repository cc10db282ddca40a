//! Episodes on disk, training windows and the min-max normaliser of Auto-E2H
