"""What is said of input that cannot be used."""

MOST_CHARACTERS = 1000
"""A message may be so long: what it quotes from files of others has any length."""
ENDING = 300
"""So much of the end of a longer one stays, where the next step is."""


class InputError(ValueError):
    """Something from outside that cannot be used: what was expected, what came, the next step, in one short line."""

    def __init__(self, message: str) -> None:
        if len(message) > MOST_CHARACTERS:
            message = f"{message[: MOST_CHARACTERS - ENDING - 5]} ... {message[-ENDING:]}"
        super().__init__(message)
