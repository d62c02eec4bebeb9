"""Mitsuba's variants, and the LLVM that some of them need."""

from __future__ import annotations

import glob
import os
import re
import sys

from .. import InputError

#: LLVM 14 and 15 (Debian 12) abort the whole process on processors with AVX-512; 19 works. 16 to 18 were not tried.
_LEAST_LLVM = 16
_PLACES = (
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
)
_HELP = "Debian and Ubuntu: apt-get install libllvm19; elsewhere set DRJIT_LIBLLVM_PATH to libLLVM of version 16 or later; or take the variant scalar_rgb"


def _version(path: str) -> int | None:
    """The major version that a library's name tells: ``libLLVM-14.0.6.so.1``, ``libLLVM.so.19.1``."""
    told = re.search(r"libLLVM-(\d+)|libLLVM\.so\.(\d+)", os.path.basename(os.path.realpath(path)))
    return int(told[1] or told[2]) if told else None


def find_llvm() -> str:
    """The path of an LLVM that Mitsuba can use: ``DRJIT_LIBLLVM_PATH``, or the newest in the usual places.

    :raises InputError: none is there, or the one that is named is too old.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        if not os.path.exists(named) or (_version(named) or _LEAST_LLVM) < _LEAST_LLVM:
            raise InputError(f"DRJIT_LIBLLVM_PATH: expected LLVM {_LEAST_LLVM} or later, found {named}. {_HELP}", "Setting")
        return named
    # By real path: a version is one library however many names it has.
    paths = {os.path.realpath(path) for place in _PLACES for path in glob.glob(place)}
    versions = sorted((_version(path) or 0, path) for path in paths)
    if not versions or versions[-1][0] < _LEAST_LLVM:
        found = ", ".join(path for _, path in versions) or "none"
        raise InputError(f"LLVM: expected version {_LEAST_LLVM} or later, found {found}. {_HELP}", "Setting")
    return versions[-1][1]


def use(variant: str = "llvm_ad_rgb") -> None:
    """Sets a variant of Mitsuba, after a look at what it needs.

    :param variant: ``llvm_ad_rgb``, ``scalar_rgb`` (a thousand times slower here: for checks), ``cuda_ad_rgb`` (not tested).
    :raises InputError: an unknown variant, one that is not RGB, or no LLVM that works.
    """
    import mitsuba as mi

    if variant not in mi.variants() or not variant.endswith("_rgb"):
        known = ", ".join(v for v in mi.variants() if v.endswith("_rgb"))
        raise InputError(f"variant: expected one of {known}, found {variant}", "Setting")
    if variant.startswith("llvm") and sys.platform != "win32":
        os.environ["DRJIT_LIBLLVM_PATH"] = find_llvm()
    mi.set_variant(variant)
