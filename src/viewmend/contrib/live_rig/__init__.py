"""Live cameras listed in a `rig.toml`: read, undistorted, masked and synchronised."""
