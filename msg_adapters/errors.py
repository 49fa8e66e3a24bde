"""The error of this package."""


class MessageError(ValueError):
    """A message that cannot be used, or a value that cannot be put into one; says what, the value, and what is allowed."""
