"""Errors a user can act on: one line that says what came, what was expected and what to do."""


class SGAMError(Exception):
    """Wrong input or an unusable environment; the command line prints it as one line."""


class ShapeError(SGAMError):
    """An array does not have the shape, type or range that a function documents."""


class InputError(SGAMError):
    """A file, folder or list that a user gave cannot be used as it is."""


class OptionError(SGAMError):
    """An option is unknown, out of range, or contradicts another one."""


class WeightsError(SGAMError):
    """The weights of a model cannot be found or are not what they should be."""


class StageError(SGAMError):
    """A stage ended before its time; everything before it has been kept."""
