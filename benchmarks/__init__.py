"""What the project claims about speed and quality, measured: `make bench`."""
