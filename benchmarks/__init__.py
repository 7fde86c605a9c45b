"""What the project claims about speed and quality, measured: `make bench`."""

MODULES = (
    "loop_speed", "tuning", "tuning_time", "test_functions", "lockstep", "live_tuning", "recorder", "writer",
    "reader", "realtime", "startup", "memory", "growth", "fleet", "live_page", "margins", "identification",
    "robust", "cluster",
)  # fmt: skip
LONG = ("seeds", "forum", "soak")  # not part of `make bench`: by name, with --only
