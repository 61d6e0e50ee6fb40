"""Where the configuration lives, and the names it offers."""

from __future__ import annotations

import os

GROUPS = ("plant", "regression", "data", "observer", "estimator", "solver", "noise", "experiment")

DATA_GROUPS = ("plant", "data", "observer", "estimator", "solver", "noise")
"""Groups whose files are values only; an experiment may choose from groups and set anything."""

LOOK = ("formats", "width", "dpi", "style", "error")
"""Keys of ``output`` that are ``figures.…`` for a person; ``figures`` alone says which ones."""

PRIMARY = "gpebo"
"""The primary configuration, conf/gpebo.yaml; another name than a run's own config.yaml."""


def conf_folder() -> str:
    """The folder of configuration files: inside the installed package, else the checkout's.

    A wheel carries it as ``gpebo_cli/conf``. An editable installation has no such copy (it
    ignores what a wheel is told to include), and a checkout keeps it at the top.
    """
    package = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    shipped = os.path.join(package, "conf")
    return shipped if os.path.isdir(shipped) else os.path.join(os.path.dirname(package), "conf")


def choices(folder: str, group: str, *, inside: bool = False) -> list[str]:
    """Names of the files of a group in ``folder``, sorted; none if there is no such group.

    With ``inside`` those in folders of the group follow, such as ``published/lorenz``.
    """
    home = os.path.join(folder, group)
    try:
        names = sorted(os.listdir(home))
    except (FileNotFoundError, NotADirectoryError):
        return []
    found = [name.removesuffix(".yaml") for name in names if name.endswith(".yaml")]
    for name in names if inside else ():
        path = os.path.join(home, name)
        if os.path.isdir(path) and not os.path.islink(path):
            found += [f"{name}/{one}" for one in choices(home, name, inside=True)]
    return found
