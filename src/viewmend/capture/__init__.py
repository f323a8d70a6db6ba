"""Where frames come from: plain capture folders and the software studio."""
