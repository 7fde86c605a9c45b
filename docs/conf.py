"""The site: `make docs`."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

project = "tdof_npid_ros"
author = "the tdof_npid_ros developers"
copyright = "Apache-2.0"
release = "0.1.0"

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
source_suffix = {".md": "myst-nb"}
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 200  # s, of a cell: the first run compiles
exclude_patterns = ["_build"]
suppress_warnings = ["myst.header"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
napoleon_use_ivar = True
html_theme = "alabaster"
html_theme_options = {
    "description": "Nonlinear two-degree-of-freedom PID loops as ROS 2 nodes",
    "page_width": "1100px",
    "sidebar_width": "260px",
}
html_show_sourcelink = False


def write_commands(app: object) -> None:
    """Write `commands.md` from the program's own arguments."""
    import argparse
    import importlib
    import os

    from tdof_npid_ros.cli import SUBCOMMANDS

    os.environ["COLUMNS"] = "90"
    parts = ["# Commands", "`tdof-npid` is one program; each subcommand has `--help` and `--json`."]
    for name, text in SUBCOMMANDS.items():
        parser = argparse.ArgumentParser(prog=f"tdof-npid {name}", description=text[0].upper() + text[1:] + ".")
        parser.add_argument("--json", action="store_true", help="print one JSON object, for scripts")
        importlib.import_module(f"tdof_npid_ros.cli.{name}").add_arguments(parser)
        parts += [f"## {name}", f"```text\n{parser.format_help()}```"]
    (Path(__file__).parent / "commands.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def setup(app: object) -> None:
    """Write what is made before the pages are read."""
    app.connect("builder-inited", write_commands)  # type: ignore[attr-defined]
