"""The native part, and what it was built with."""

from . import _acquire as native

version: str = native.version
#: Whether :func:`acquire.build_matrix` finds chessboards (built with the feature ``opencv``).
has_opencv: bool = native.opencv
