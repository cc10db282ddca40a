//! MuJoCo task pairs, cameras, control and scripted demonstrators of Auto-E2H
