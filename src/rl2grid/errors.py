"""The one exception that a user is meant to read, and the one warning."""


class UsageError(ValueError):
    """A request that cannot be met: one sentence saying what was wrong and what is allowed.

    The command line prints the sentence alone, without a traceback.
    """


class DamageWarning(UserWarning):
    """A file that was damaged, and what was done without it; the command line prints the sentence alone."""


def one_of(what: str, value: object, allowed: "list[str] | tuple[str, ...]") -> UsageError:
    """The error for a value outside a closed list, naming every allowed value."""
    return UsageError(f"{what} {value!r} does not exist: choose one of {', '.join(map(str, allowed))}.")
