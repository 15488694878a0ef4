"""Whether the pose filter's errors on rendered pictures are as large as it says, for parts at rest and in motion.

    python benchmarks/filter_consistency.py --runs 100 --seed 5000

A hand approaches the part from 0.6 m to 0.25 m with the camera on it, whose mount is believed 0.5 mm and 0.1° beside
where it is; the part lies still, rides on a conveyor at 0.1 m/s, or turns slowly. Writes filter_consistency.json.
"""

from __future__ import annotations

import argparse

from rich.console import Console
from rich.table import Table

from dyngrasp.experiments.filter_consistency import MOTIONS, filter_consistency
from dyngrasp.experiments.output import OutputFolder, write_json
from dyngrasp.experiments.provenance import machine, versions


def main() -> None:
    """Film, filter, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="of each motion")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=MOTIONS)
    parser.add_argument("--out", default="out/filter_consistency")
    options = parser.parse_args()
    console = Console(width=140)
    with OutputFolder(options.out) as out:
        with Console(stderr=True).status("…") as status:
            rows = filter_consistency(options.runs, options.seed, options.motions, status.update)
        table = Table(title="errors of the filtered pose, and their normalised square against its 95 % bounds")
        for name in rows[0]:
            table.add_column(name, justify="right")
        for row in rows:
            table.add_row(*(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()))
        console.print(table)
        document = {"runs": options.runs, "seed": options.seed, "rows": rows}
        write_json(out / "filter_consistency.json", document | {"machine": machine(), "versions": versions()})


if __name__ == "__main__":
    main()
