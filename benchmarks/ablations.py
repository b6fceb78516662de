"""Results of students with different touch, and the pages that compare them: docs/background and docs/records/ablations.md.

    python benchmarks/ablations.py collect out/ablation in_palm_rotate_types --teacher out/teacher.json --rest out/rest.json
    python benchmarks/ablations.py reading                    # how well the force of grip_force can be read from each type
    python benchmarks/ablations.py page                       # tables and plots from all that is kept

`collect` copies a run's tables and thinned curves to docs/measured/ablations, in place of what was kept under the name; a run
that went on with --resume is collected again. Runs that differ in their overrides alone, as in students' networks, are kept as
SERIES__WHAT and have one table and plot. `page` writes between the markers of both pages, and a plot of each run to
docs/images/ablation_NAME.png.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ablations_collect import ROWS, collect
from ablations_kept import KEPT, ROOT
from ablations_page import PAGE, READING, RECORD, write_page, write_summary

from tgdsl.errors import TgdslError


def collected(given: argparse.Namespace) -> None:
    size = collect(given.run, given.name, given.teacher, given.rest, given.kept, given.rows)
    print(f"{given.kept / given.name}: {size / 1e3:.0f} kB")


def read(given: argparse.Namespace) -> None:
    from ablations_reading import readings, record, write_readings

    from tgdsl.console.tables import text_table
    from tgdsl.files.write import check_writable
    from tgdsl.rl.load import load_task
    from tgdsl.rl.sensors import num_variants

    check_writable(given.out)
    loaded = load_task(given.task)
    recorded = record(loaded, given.teacher, given.envs, given.episodes, given.placement)
    found = readings(recorded, num_variants(loaded))
    cells = [(own.type, f"{own.numbers}", f"{own.r2:.3f}", f"{own.rms:.3f}", f"{own.relative:.1%}") for own in found]
    print(text_table(("type", "numbers", "R²", "RMS error [N]", "relative"), cells))
    write_readings(found, given.out, sys.argv[1:])
    print(given.out)


def paged(given: argparse.Namespace) -> None:
    for file in (*write_page(given.kept, given.page), write_summary(given.kept, given.summary)):
        print(file)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(required=True)
    own = kinds.add_parser("collect")
    own.add_argument("run", type=Path, help="folder of a run of tgdsl distill")
    own.add_argument("name", help="name of the ablation: small letters, digits, _")
    own.add_argument("--teacher", type=Path, help="what tgdsl evaluate --policy TEACHER --out wrote")
    own.add_argument("--rest", type=Path, help="what tgdsl evaluate --out wrote without a policy")
    own.add_argument("--rows", type=int, default=ROWS, help="most rows of each curve")
    own.add_argument("--kept", type=Path, default=KEPT)
    own.set_defaults(run_it=collected)
    own = kinds.add_parser("reading")
    own.add_argument("task", type=Path, nargs="?", default=ROOT / "examples" / "tasks" / "grip_force.yaml")
    own.add_argument("--teacher", type=Path, default=ROOT / "policies" / "grip_force.pt")
    own.add_argument("--envs", type=int, default=48)
    own.add_argument("--episodes", type=int, default=4, help="episodes' worth of control steps in each environment")
    own.add_argument("--placement", default="hand")
    own.add_argument("--out", type=Path, default=KEPT / READING)
    own.set_defaults(run_it=read)
    own = kinds.add_parser("page")
    own.add_argument("--kept", type=Path, default=KEPT)
    own.add_argument("--page", type=Path, default=RECORD, help="page for the tables of all runs")
    own.add_argument("--summary", type=Path, default=PAGE, help="page for the table of mean scores")
    own.set_defaults(run_it=paged)
    given = parser.parse_args()
    try:
        given.run_it(given)
    except TgdslError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
