"""Training configurations, data, losses and the loop."""
