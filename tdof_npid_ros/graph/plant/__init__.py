"""The plant node and its two ways of running: lockstep and realtime."""
