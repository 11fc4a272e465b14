"""What a command found or did: sentences for a person, or one JSON object on a line for a script."""

import argparse
import json
from collections.abc import Iterable, Mapping


def add_json(parser: argparse._ActionsContainer) -> None:
    """Add `--json` to a parser or a group of one."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else, on stdout")


def tell(result: Mapping[str, object], sentences: Iterable[str], *, as_json: bool) -> None:
    """Print the one or the other."""
    if as_json:
        print(json.dumps(result, ensure_ascii=False), flush=True)
    else:
        print(*sentences, sep="\n", flush=True)
