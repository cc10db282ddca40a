//! Episodes, poses, specs and seeded random streams of Auto-E2H
