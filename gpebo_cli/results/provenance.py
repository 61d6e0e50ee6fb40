"""Which code made a result: versions of the packages, and the commit if it is a checkout."""

from __future__ import annotations

import os
import platform
import subprocess
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from gpebo_cli import kernels
from gpebo_cli._version import __version__

PACKAGES = ("numpy", "scipy", "pandas", "hydra-core", "omegaconf", "matplotlib")


@dataclass(frozen=True)
class GitState:
    """The checkout the package runs from; ``dirty`` counts untracked files that are not ignored."""

    commit: str | None  # None before the first commit
    dirty: bool


@dataclass(frozen=True)
class Provenance:
    """Versions by package, ``None`` for one that is not installed, and the state of the code."""

    versions: dict[str, str | None]
    git: GitState | None  # None when the package is installed and not a checkout


def provenance() -> Provenance:
    """Collect both; takes some 10 ms, most of it git, and never fails."""
    versions: dict[str, str | None] = {
        "gpebo": __version__,
        "kernels": kernels.kind(),
        "python": platform.python_version(),
    }
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    return Provenance(versions, git_state(Path(__file__).parents[2]))


def git_state(root: Path) -> GitState | None:
    """State of the git checkout whose top is ``root``; None if it is none or git cannot tell."""
    if not (root / ".git").exists():  # a file in a linked worktree
        return None
    # One process tells both. Without optional locks it never disturbs a git command of the user;
    # inside a git hook GIT_DIR and friends would point it at another repository.
    command = ["git", "--no-optional-locks", "-C", str(root), "status", "--porcelain=v2",
               "--branch"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}
    try:
        done = subprocess.run(  # noqa: S603  git, with arguments of our own
            command, capture_output=True, text=True, timeout=5, env=environment, check=True
        )
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    lines = done.stdout.splitlines()
    commit = next((line.split()[2] for line in lines if line.startswith("# branch.oid ")), None)
    dirty = any(not line.startswith("#") for line in lines)
    return GitState(None if commit == "(initial)" else commit, dirty)
