"""The page in the browser: a loop seen and steered while it runs, through ROS 2 alone."""
