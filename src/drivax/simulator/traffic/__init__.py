"""Traffic models: how every agent that is not driven moves."""
