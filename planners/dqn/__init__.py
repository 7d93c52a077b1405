"""The belief DQN: learner, replay buffer, checkpoints, and what the published code does otherwise."""
