"""What makes it a learning problem: observations, rewards, action spaces, termination."""
