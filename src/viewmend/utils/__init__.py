"""Files, JSON, logging, plugins and timing."""
