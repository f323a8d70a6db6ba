"""A live rig: cameras that this machine reads itself, by a `rig.toml`; their pictures masked, straightened, aligned."""
