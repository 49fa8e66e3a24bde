"""The error of a message that cannot be understood or made."""


class MessageError(ValueError):
    """A message, or what should become one, that cannot be used: what, the value, what is allowed."""
