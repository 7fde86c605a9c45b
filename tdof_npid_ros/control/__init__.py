"""The control law: gains, the sampled law, and the controller that answers outputs."""
