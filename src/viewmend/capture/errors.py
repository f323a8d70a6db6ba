"""What is wrong with a capture, or with material for the studio."""


class CaptureError(ValueError):
    """Input that cannot be used: the message names the file, what was expected, what came, and the next step."""
