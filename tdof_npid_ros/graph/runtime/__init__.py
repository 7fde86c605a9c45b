"""What every node stands on: its life cycle, parameters, endpoints, raw subscriptions, timing and end."""
