"""`tdof-npid identify`: a plant's model from a recording."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from tdof_npid_ros.cli.choice import add_choice, choice
from tdof_npid_ros.cli.terminal import say
from tdof_npid_ros.identification import IdentificationError
from tdof_npid_ros.identification.identify import identify
from tdof_npid_ros.identification.records import read_records
from tdof_npid_ros.identification.result import as_json, draft_of, draw, table
from tdof_npid_ros.identification.structures import STRUCTURES
from tdof_npid_ros.one_line import as_text
from tdof_npid_ros.output_file import OutputError, check_outputs
from tdof_npid_ros.parameter_file import ParameterFileError
from tdof_npid_ros.plants.plant import PlantError
from tdof_npid_ros.tuning import TuningError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this subcommand's arguments."""
    parser.add_argument("bags", nargs="+", metavar="BAG", help="bag folders, .mcap or .db3 files of one plant")
    parser.add_argument("--episode", metavar="NAME", help="only this episode, by name or number (default: all)")
    add_choice(parser)
    parser.add_argument("--structure", metavar="NAME", help=f"instead of the best: {', '.join(STRUCTURES)}")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the plant as a parameter file for all commands")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="picture of measured and predicted output")


def run(arguments: argparse.Namespace) -> int:
    """Identify, print what was found, and write what was asked for."""
    if arguments.structure is not None and arguments.structure not in STRUCTURES:
        raise IdentificationError(f"no structure {arguments.structure!r}: there are {', '.join(STRUCTURES)}")
    if arguments.out is not None:
        if arguments.out.suffix not in (".yaml", ".yml"):
            raise ParameterFileError(f"{arguments.out}: a parameter file's name ends with .yaml")
        if arguments.out.exists():
            raise OutputError(f"{arguments.out} exists and is not overwritten: give another name")
    check_outputs([path for path in (arguments.out, arguments.plot) if path], [Path(bag) for bag in arguments.bags])
    records = read_records(arguments.bags, arguments.episode, choice(arguments))
    structures = [STRUCTURES[arguments.structure]] if arguments.structure else list(STRUCTURES.values())
    found = identify([record.stretch for record in records], structures)
    title = f"Identified from {', '.join(as_text(Path(bag).name) for bag in arguments.bags)}"
    try:
        draft = draft_of(found, records, title)
        text = draft.text()
    except (PlantError, TuningError) as error:
        if arguments.out is not None:
            raise
        draft, text = None, f"no parameter file can be made of it: {error}"
    if arguments.out is not None:
        arguments.out.write_text(text, encoding="utf-8")
    if arguments.plot is not None:
        draw(found, records, arguments.plot)
    if arguments.json:
        print(json.dumps(as_json(found, draft), allow_nan=False))
        return 0
    say(f"note: {note}" for note in dict.fromkeys(note for record in records for note in record.notes))
    say([*table(found).splitlines(), *([text] if draft is None else [])])
    for path in (arguments.out, arguments.plot):
        if path is not None:
            print(f"written: {path}")
    return 0
