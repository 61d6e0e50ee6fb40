"""``gpebo new plant NAME``: a commented plant file that runs as it stands."""

from __future__ import annotations

import os
import re
import shlex
import sys
from pathlib import Path

from gpebo_cli.cli.locations import choices, conf_folder
from gpebo_cli.cli.options import CONFIG_DIR, parse
from gpebo_cli.errors import ConfigError
from gpebo_cli.schema import nearest, shown

KINDS = ("plant",)

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,79}")
_WORDS = ("null", "true", "false", "yes", "no", "on", "off", "nan", "inf")  # mean more in YAML

TEMPLATE = """\
# A plant is data: text that gpebo reads and never executes.
#
#   E(t) x' = A(t) x + B(t) u(t) + F(t) θ,    y = C(t) x
#
# This one is an example that runs as it stands. Change it a line at a time, and ask
#
#   gpebo check --config-dir {folder} plant={name}
#
# what holds and what does not. An entry is a number or an expression in t (seconds) and in the
# parameters:   + - * / **   sin cos tan exp log sqrt sinh cosh tanh abs sign   pi
# d(a) is the derivative of a in time, step(t - 3) is 0 before t = 3 and 1 from then on.

name: {name}
title: heated tank, an unknown loss of heat      # shown by gpebo list plants
reference: null                                  # where the model is from

# (Cap T)' = q + loss        the tank's temperature T: stored heat changes by what comes in
#        0 = -k T - q + P    the heat q that reaches the tank: no derivative, so an algebraic state
#        y = T + q/2         what is measured
parameters:                     # known; each may use t and those above it
  k: 0.8
  Cap: 2 + 0.5*sin(t/2)
states: [T, q]                  # E and A have one row and one column for each
inputs:                         # known signals; B has a column for each
  P: 3 + 2*sin(t)
unknowns:                       # θ, constant, to be estimated; F has a column for each.
  loss: -0.4                    # The value is the truth, which only the simulation gets to see
outputs: [y]                    # C has a row for each

E:                              # (Cap T)' = Cap T' + Cap' T, the last term goes into A
  - [Cap, 0]
  - [0, 0]                      # a row of zeros: an algebraic equation
A:
  - [-d(Cap), 1]
  - [-k, -1]
B:
  - [0]
  - [1]
F:
  - [1]
  - [0]
C:
  - [1, 0.5]

initial_state: {{T: 1, q: 0}}     # q need not be right: gpebo finds the consistent one and says so

units: {{T: K, q: W, P: W, loss: W, y: K}}         # labels of figures
observer_defaults:
  xi_a0: {{T: 0}}                 # where the observer starts; it does not know T(0)
"""


def main(words: list[str]) -> int:
    """Write the file; the exit code.

    Raises:
        ConfigError: no such kind, a name that cannot be one, or a file that exists.
        GpeboError: the file cannot be written.
    """
    if not {"--help", "-h"}.isdisjoint(words):
        from gpebo_cli.cli.usage import NEW_HELP

        sys.stdout.write(NEW_HELP)
        return 0
    kind, name, folder = _parse(words)
    path = Path(folder, kind, f"{name}.yaml")
    _check_name(kind, name, path)

    from gpebo_cli.results.files import make_folder, write_text

    make_folder(path.parent)
    where = shlex.quote(folder)
    write_text(path, TEMPLATE.format(name=name, folder=where))
    sys.stdout.write(
        f"{path}\n"
        f"it runs as it stands:      gpebo run --config-dir {where} {kind}={name}\n"
        f"when you have changed it:  gpebo check --config-dir {where} {kind}={name}\n"
    )
    return 0


def _parse(words: list[str]) -> tuple[str, str, str]:
    """Kind, name and folder."""
    options = parse("new", words, CONFIG_DIR)
    given = options.words
    if not given or given[0] not in KINDS:
        what = f"gpebo new: {shown(given[0])} cannot be made" if given else "gpebo new needs a kind"
        raise ConfigError(
            f"{what}; known: {', '.join(KINDS)}, as in gpebo new plant tank"
            + (nearest(given[0], KINDS) if given else "")
        )
    if len(given) != 2:
        got = "none" if len(given) == 1 else ", ".join(map(shown, given[1:]))
        raise ConfigError(
            f"gpebo new {given[0]} needs one name, as in gpebo new {given[0]} tank; got {got}"
        )
    return given[0], given[1].removesuffix(".yaml"), os.path.expanduser(options.config_dir or ".")


def _check_name(kind: str, name: str, path: Path) -> None:
    if not _NAME.fullmatch(name) or name.lower() in _WORDS:
        raise ConfigError(
            f"gpebo new {kind}: {shown(name)} cannot be a name; it is a letter, then letters, "
            f"digits, _ and - (80 at most), and none of {', '.join(_WORDS)}"
        )
    if name in choices(conf_folder(), kind):
        raise ConfigError(
            f"gpebo new {kind}: {name} comes with gpebo, and yours would be ignored; choose "
            "another name"
        )
    if path.exists() or path.is_symlink():
        raise ConfigError(f"{path} exists already; remove it, or choose another name")
