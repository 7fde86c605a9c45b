"""Plants: what is controlled, discretised for the closed loop."""
