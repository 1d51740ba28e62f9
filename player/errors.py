"""All errors that this project raises on purpose. This module imports nothing.

A message has the form *where: what: expected, got*, with a hint if there is a fix. The command lines print it
without a traceback and exit with code 1. Anything else that is raised is a bug and keeps its traceback.
"""


class VfrError(Exception):
    """Base of every error raised on purpose."""


class ShapeError(VfrError, ValueError):
    """An array does not have the shape that its name promises."""


class ConfigError(VfrError, ValueError):
    """A setting is out of range or contradicts another."""


class DataError(VfrError, ValueError):
    """A data set cannot be used: path, what was expected, what was found."""


class FormatError(VfrError, ValueError):
    """A file, or a camera made in a program, breaks its format: path or name, field, expected, got."""


class VersionError(FormatError):
    """A file has a version that this program does not read."""


class IntegrityError(FormatError):
    """Bytes do not match their checksum or their stated size."""


class ParityError(VfrError):
    """An export does not reproduce its source: quantity, worst, where, tolerance."""


class OutputError(VfrError, OSError):
    """A result cannot be written: the target exists, is read-only, or the disk is full."""


class TrainingError(VfrError, RuntimeError):
    """Training or baking cannot go on: the reason, and what to change."""


class MissingExtraError(VfrError, ImportError):
    """A feature needs `pip install 'vfr-bake[extra]'`."""
