"""What the user of a command can mend."""


class UsageError(Exception):
    """Something that the user can mend; the message says how."""
