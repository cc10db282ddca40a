//! DDIM diffusion policy and critic of Auto-E2H, with their checkpoints
