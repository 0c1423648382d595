"""stereophd: 3-D tracks from the detection logs of several cameras.

The names below are the public interface; the page "Python" of the documentation shows how to use them. Each is imported
when it is first used, so that ``import stereophd`` takes almost no time. Modules and names that are not listed here are
private: they may change without notice.
"""

import os

__version__ = "0.1.0"

# One target of compiled code for every x86 processor with AVX2 (since 2013): numba, OpenBLAS and NumPy read theirs when
# they are first imported. Other architectures have one set of instructions that all their processors share.
if os.environ.get("STEREOPHD_TARGET") == "portable":
    if not hasattr(os, "uname") or os.uname().machine == "x86_64":
        if os.environ.setdefault("NUMBA_CPU_NAME", "haswell") == "haswell":
            os.environ.setdefault("NUMBA_CPU_FEATURES", "")  # those of the name, not of this processor
        os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
        os.environ.setdefault("NPY_DISABLE_CPU_FEATURES", "X86_V4 AVX512F AVX512CD AVX512_SKX AVX512_ICL AVX512_SPR")
    else:
        os.environ.setdefault("NUMBA_CPU_NAME", "generic")


def _public_names() -> dict[str, str]:
    """Return public name -> module that holds it, from the stub beside this file."""
    with open(f"{__file__.removesuffix('c')}i", encoding="utf-8") as stub:
        words = [line.split() for line in stub if line.startswith("from ")]
    return {name: home for _, home, _, name, *_ in words}


_HOMES = _public_names()
__all__ = [*sorted(_HOMES), "__version__"]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module 'stereophd' has no attribute {name!r}")
    from importlib import import_module

    value: object = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
