"""The closing task: guidance, rewards, stages, observer, environment."""
