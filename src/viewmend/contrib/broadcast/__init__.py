"""One viewer's view, encoded once as HLS for any number of browsers."""
