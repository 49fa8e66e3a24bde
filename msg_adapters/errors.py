"""The error of this package."""

LONGEST = 1000


class MessageError(ValueError):
    """A message that cannot be used, or a value that cannot be put into one; says what, the value, and what is allowed.

    It is one line, whatever texts the message holds.
    """

    def __init__(self, text: str) -> None:
        """Make one printable line of the text; the middle of a very long one is left out."""
        line = ''.join(character if character.isprintable() else ' ' for character in text)
        super().__init__(line if len(line) <= LONGEST else f'{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}')
