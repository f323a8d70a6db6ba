"""Broadcasting one view to any number of browsers as HLS."""
