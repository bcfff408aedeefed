"""PPO on Brax parts: training state, checkpoints, resume."""
