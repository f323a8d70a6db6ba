"""What can be wrong with a capture."""

from viewmend.foreign_input import InputError


class CaptureError(InputError):
    """A capture that cannot be used.

    The message names the file, the camera and the frame, what was expected, what came, and the next step.

    Examples:
        >>> from viewmend import CaptureError, open_capture
        >>> try:
        ...     open_capture("nowhere")
        ... except CaptureError as error:
        ...     print("check the path" in str(error))
        True
    """
