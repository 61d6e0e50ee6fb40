"""Compile the kernels into the wheel; where that fails the wheel is pure Python, and slower."""

from __future__ import annotations

import os
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = Path("gpebo_cli/kernels")
STABLE_SINCE = (3, 11)  # the oldest Python we run on: one wheel serves it and all later ones
WARNINGS = ["-Wall", "-Wextra"]


class KernelsHook(BuildHookInterface):  # type: ignore[type-arg]
    """Hatchling's ``custom`` build hook."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; an editable install gets the module beside its sources."""
        asked = os.environ.get("GPEBO_KERNELS")
        if self.target_name != "wheel" or asked == "numpy":
            return
        try:
            built = compile_kernels(Path(self.root))
        except Exception as error:  # no compiler, no headers: all the same to us
            if asked == "compiled":
                raise
            self.app.display_warning(f"the kernels were not compiled ({error}); NumPy does it")
            return
        if version == "editable":
            into_checkout(Path(self.root), built)
        build_data["force_include"][str(built)] = (FOLDER / built.name).as_posix()
        build_data["pure_python"] = False
        python = "cp{}{}".format(*STABLE_SINCE)
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"{python}-abi3-{platform}"


def into_checkout(root: Path, built: Path) -> None:
    """Put the module beside its sources; processes that have loaded the old one keep it."""
    target = root / FOLDER / built.name
    beside = target.with_suffix(".new")
    beside.write_bytes(built.read_bytes())
    beside.replace(target)


def compile_kernels(root: Path, *options: str) -> Path:
    """The compiled module, in a new folder.

    Args:
        root: the checkout.
        options: more of the compiler's.
    """
    import numpy as np
    from setuptools import Distribution, Extension
    from setuptools.command.build_ext import build_ext

    unix = sys.platform != "win32"
    # Contracted multiplications would round otherwise on one processor than on the next.
    usual = ["-std=c11", "-O3", "-g0", "-ffp-contract=off", "-fno-math-errno"]
    usual += ["-fopenmp-simd", *WARNINGS]  # loops that say so are vectorised; there are no threads
    extension = Extension(
        "gpebo_cli.kernels._compiled",
        sources=[str(path) for path in sorted((root / FOLDER).glob("*.c"))],
        include_dirs=[np.get_include(), str(root / FOLDER)],
        define_macros=[("Py_LIMITED_API", "0x{:02X}{:02X}0000".format(*STABLE_SINCE))],
        extra_compile_args=[*(usual if unix else []), *options],
        extra_link_args=list(options),
        py_limited_api=True,
    )
    folder = tempfile.mkdtemp(prefix="gpebo-kernels-")
    command = build_ext(Distribution({"name": "gpebo", "ext_modules": [extension]}))
    command.build_lib, command.build_temp = f"{folder}/lib", f"{folder}/temp"
    command.ensure_finalized()
    command.run()
    return Path(command.get_ext_fullpath(extension.name))


if __name__ == "__main__":  # `make kernels`, after a change of the C
    here = Path(__file__).parent
    into_checkout(here, compile_kernels(here, *sys.argv[1:]))
