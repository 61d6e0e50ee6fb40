"""What `--help` prints. Plain text: it is shown without importing anything."""

from __future__ import annotations

from gpebo_cli.configs.locations import GROUPS, choices, conf_folder, default

HELP = """\
gpebo: adaptive state observers for linear time-varying descriptor systems

usage: gpebo COMMAND …

commands:
  run [OVERRIDES]     one experiment: simulate, observe, estimate, check excitation
  check [OVERRIDES]   every assumption of the plant and the observer, with its evidence
  compare DIR …       one table and figures over finished runs and sweeps
  report DIR …        runs and sweeps as one page that stands alone, report.html
  figures [NAME …]    the paper's figures and tables, in outputs/paper
  reproduce [NAME …]  published numbers beside ours, from experiments/published
  list [KIND]         what there is: plants, regressions, observers, estimators, …
  new KIND NAME       a plant, estimator, observer or recipe of yours, which works as it stands
  completion SHELL    completion of commands, groups and names for bash, zsh or fish

options:
  -h, --help          this text; gpebo run --help has groups, defaults and more examples
  -V, --version       the version

examples:
  gpebo run plant=circuit estimator=drem             # the paper's experiment
  gpebo run 'estimator.gamma=[1e8,1e10]'             # two gains in one run
  gpebo run -m estimator.gamma=1e6,1e8 hydra.sweep.dir=gains     # a run for each, one results.csv
  gpebo compare gains                                # who was best, by which gain
  gpebo new plant tank                               # your plant, in ./plant/tank.yaml
  gpebo check --config-dir . plant=tank              # what holds, what does not, by how much
  gpebo run --config-dir . plant=tank
  gpebo figures paper_circuit                        # the paper's figures, outputs/paper
  gpebo list plants

exit codes: 0 done, 1 the run failed, 2 wrong usage or configuration, 130 interrupted
"""

HELP_OF = {
    "check": """\
usage: gpebo check [OVERRIDES] [OPTIONS]

Checks every assumption that a run with these OVERRIDES (those of gpebo run) would rest on:
solvability and index, a consistent start, the rank of E, impulse observability, excitation, and
those of the canonical form. What fails comes with what to do about it. Nothing is estimated or
written. Exit code 1 if something that is needed does not hold. Below the assumptions stands, for
each parameter and state, from when on the outputs determine it.

options:
  sensors=all         tries every state as a further output: what becomes estimable, the best first
  --json              for a program instead of a person
  --config-dir DIR    a folder of yours with plant/NAME.yaml
  -h, --help          this text

examples:
  gpebo check plant=circuit
  gpebo check plant=circuit observer.regression=paper
  gpebo check plant=canonical observer=canonical --json
  gpebo new plant tank
  gpebo check --config-dir . plant=tank
""",
    "compare": """\
usage: gpebo compare DIR … [OPTIONS]

One table over finished runs and sweeps, the best first, and figures: error curves overlaid,
metrics over every gain that varies, a heat map where two do. DIR is a folder of a run or of a
sweep; of a sweep that is not finished, what is there. Gains, tolerances, whatever varies and is
a positive number makes an axis. Of a folder of runs, outputs/runs for instance, all are taken.

options:
  --sort COLUMN       seconds_to_1pct_parameters by default, under noise rms_error_states;
                      heat maps show it
  --reverse           largest first
  --columns A,B,…     these columns, in this order: gains, settings, metrics of all or of one
                      quantity (seconds_to_1pct_x), estimates at the end (x_hat, x_std)
  --csv FILE          the whole table, every digit
  --output DIR        where to draw; outputs/comparisons/<time> by default
  --no-figures        the table only
  -h, --help          this text

examples:
  gpebo run -m estimator.gamma=1e6,1e8 estimator=drem,lion hydra.sweep.dir=both
  gpebo compare both
  gpebo compare both --columns run,gamma,e0_il_hat,seconds_to_1pct_il --no-figures
  gpebo compare both/0 both/1 --sort final_error_states --csv best.csv --no-figures
""",
    "report": """\
usage: gpebo report DIR … [--output FILE]

One HTML page over finished runs and sweeps, with everything in it: verdicts, assumptions and their
evidence, estimates and metrics, figures, configuration, versions. It needs no other file and no
network; a click enlarges a figure. DIR is a folder of a run or a sweep, or a folder of those.

options:
  --output FILE       report.html by default
  -h, --help          this text

examples:
  gpebo run plant=circuit hydra.run.dir=circuit
  gpebo report circuit
  gpebo report circuit --output page.html
""",
    "figures": """\
usage: gpebo figures [NAME …] [OPTIONS]

Runs recipes, by default those of the paper, and writes their figures to outputs/paper, a CSV
file with what is drawn beside each, and a page with all of them, index.html. The same code on the
same machine writes the same tables, byte for byte.

options:
  figures.formats=[png,pdf,svg]  formats besides PNG, which is always written
  --config-dir DIR    a folder of yours with experiment/NAME.yaml, whose recipes can be named, too
  --output DIR        where to write
  --check DIR         compare with the tables in DIR; exit code 1 if a curve differs
  --update DIR        write the tables that --check compares with
  -q, -v              nothing but errors; how long each stage takes
  -h, --help          this text

examples:
  gpebo figures paper_circuit                        # without a name, all of them
  gpebo figures literal_regressor 'figures.formats=[png,pdf]' --update tables
  gpebo figures literal_regressor --check tables
  gpebo new recipe mine
  gpebo figures mine --config-dir .
""",
    "reproduce": """\
usage: gpebo reproduce [NAME …] [--page FILE]

Runs the recipes of experiments/published, by default all of them, and prints every published
number beside ours. Exit code 1 if one is off by more than its tolerance. A recipe whose data have
to be downloaded runs where they are in the current folder. --page writes the table as a page of
Markdown, and small figures beside it in img/atlas; -q prints nothing but errors, -v how long each
stage takes.

examples:
  gpebo reproduce gear_petzold
  gpebo reproduce fct_agent1 circuit
  gpebo reproduce brenan --page atlas.md
""",
    "list": """\
usage: gpebo list [KIND …] [--config-dir DIR]

What can be chosen in gpebo run, one line each: its name and what it is. KIND is plants,
observers, estimators or experiments; without one, all are listed. With --config-dir, yours too.

examples:
  gpebo list
  gpebo list plants
  gpebo list plants experiments --config-dir .
""",
    "new": """\
usage: gpebo new {plant|estimator|observer|recipe} NAME [--config-dir DIR] [--from FILE …]
       gpebo new recording FILE.csv --plant NAME [--config-dir DIR]

Writes below DIR, by default the current folder; nothing that exists is overwritten.

  plant      DIR/plant/NAME.yaml: every key explained; it runs as it stands
  estimator  DIR/NAME.py, its settings DIR/estimator/NAME.yaml, its test DIR/test_NAME.py, and
             DIR/pyproject.toml, by which gpebo finds it once it is installed; the test passes
  observer   the same files for an observer
  recipe     DIR/experiment/NAME.yaml: an experiment as a file; it runs as it stands
  recording  DIR/data/FILE.yaml: which column of FILE.csv is which signal of the plant, separators,
             units, gaps, as far as they can be guessed; and what was not understood

With --from FILE a plant is made from a SPICE netlist (.cir .net .sp), a mechanical model (.yaml
with M, D, K, G), or matrices (.mat, .npz, a folder of Matrix Market files, an OpenModelica
linearisation, .py .m .jl). --measure "v(out), y=i(L1)+i(V)", or names of states, says what the
outputs are, --unknown I5,V3 which constant inputs are unknown. Of more than 50 states constant
matrices are written to DIR/plant/NAME.npz.

examples:
  gpebo new plant tank
  gpebo run --config-dir . plant=tank
  gpebo new plant boiler --config-dir models
  gpebo check --config-dir models plant=boiler
  gpebo new estimator ridge --config-dir ridge
  gpebo new recipe two_gains
  gpebo run --config-dir . experiment=two_gains
""",
    "completion": """\
usage: gpebo completion bash|zsh|fish

Prints a script that completes commands, options, groups and their values (yours, too, after
--config-dir DIR), keys, figures and folders. Load it in the shell's start-up file:

  ~/.bashrc                     eval "$(gpebo completion bash)"
  ~/.zshrc, after compinit      eval "$(gpebo completion zsh)"
  ~/.config/fish/config.fish    gpebo completion fish | source
""",
}
"""The help of each command but ``run``."""

_RUN_HELP = """\
usage: gpebo run [OVERRIDES] [OPTIONS]

Runs one experiment and writes its tables, figures and summary.json to a new folder in
outputs/runs. OVERRIDES are Hydra's: group=choice, key.subkey=value, in any order.

groups (the first is the default unless marked):
{groups}
other keys, with their defaults:
  time.start=null time.horizon=null                  seconds; null: 0 and 20, or the recording's
  time.samples=1001                                  of the output grid only
  data.file=FILE data.hold=linear                    a recording: zoh, linear or cubic; -: stdin
  observer.sample_time=null                          seconds; null: continuous time
  excitation.rho=null excitation.window=null         null: chosen from the regressor, the horizon
  figures=null                                       all, none or [names]; null: none in a sweep
  figures.formats=[png]  figures.width=column        png, pdf, svg; column, page or inches
  figures.dpi=200  figures.style=null                a style of matplotlib's; null: ours
  figures.error=log                                  linear: errors with their sign
  output.max_rows=100000  output.parquet=false       of estimates.csv; tables as Parquet, too
  hydra.run.dir=FOLDER                               where to write
  gpebo run --cfg job prints every key with its value

options:
  -m, --multirun      a run for every combination of the values given as key=a,b,c, and for each
                      value of key=logspace(a,b,n); key=[a,b,c] is one run with three cases
  --dry-run           of a sweep: list the jobs
  resume=FOLDER       of a sweep: the same command again runs what is missing or failed
  fail_fast=true      of a sweep: stop at the first job that fails
  launcher=NAME       of a sweep: basic, one after the other; joblib, all cores; ray; slurm
  --config-dir DIR    a folder of yours with plant/NAME.yaml, experiment/NAME.yaml, …
  --config-name NAME  another primary configuration; a run's own is config.yaml in its folder
  -q, --quiet         nothing but errors and warnings
  -v, --verbose       how long each stage takes, meshes, error estimates, versions, on stderr
  --cfg job           print the configuration and stop; add --resolve to fill in ${{…}}
  --hydra-help        options of Hydra that are rarely needed
  -h, --help          this text

examples:
  gpebo run plant=circuit estimator=drem
  gpebo run 'estimator.gamma=logspace(6,12,100)' 'figures=[gains]'    # one run, 100 cases
  gpebo run -m plant=circuit,descriptor estimator=drem,ls_drem        # a run for each of four
  gpebo run noise=gaussian noise.outputs=0.01 noise.seed=1            # noisy outputs
  gpebo run observer=none time.horizon=5                              # simulate only
  gpebo run experiment=paper_circuit hydra.run.dir=paper              # a recipe, and where to
  gpebo run --config-dir paper --config-name config                   # repeat that run
  gpebo run data.file=paper/signals.csv data.hold=cubic               # measured, not simulated
  gpebo run data.file=- estimator=ls_drem < paper/signals.csv         # a row out for each row in
"""
_NOTES = {"experiment": "   (a recipe; none by default)"}


def run_help() -> str:
    """The help of ``gpebo run``, with the groups' choices as they are on disk."""
    folder = conf_folder()
    lines = []
    for group in GROUPS:
        names = choices(folder, group)
        first = default(group)
        names.sort(key=lambda name: name != first)  # stable: the default first, rest by name
        text = f"{' '.join(names)}{_NOTES.get(group, '')}"
        lines += _wrapped(f"  {group + '=':<12} ", text)
    return _RUN_HELP.format(groups="".join(lines))


def _wrapped(head: str, text: str) -> list[str]:
    """Lines of at most 100 characters; ``textwrap`` takes longer to load than all of this."""
    lines = [head]
    for word in text.split(" "):
        if len(lines[-1]) + len(word) >= 100:
            lines.append(" " * len(head))
        lines[-1] += f"{word} "
    return [f"{line.rstrip()}\n" for line in lines]
