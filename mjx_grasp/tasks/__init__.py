"""What is learnt: tasks with their starts, observations, rewards and success."""
