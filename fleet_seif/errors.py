"""The failures that callers tell apart. A bad argument or a bug of ours is a ValueError."""


class WireError(Exception):
    """Bytes from a peer that are not a valid message. Counted, logged, dropped; never a crash."""


class NumericalError(ArithmeticError):
    """A matrix that should be positive definite is not, or a number outgrew its limit."""


class ReadingRefused(ValueError):
    """A reading that the filter will not take; the filter is as it was before."""


class RunError(Exception):
    """A run that cannot start or go on: says what, where and the remedy. Exit code 1."""
