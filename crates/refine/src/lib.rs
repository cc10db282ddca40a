//! Reversal, kinematic filter and advantage filter of Auto-E2H: pure functions on episodes
