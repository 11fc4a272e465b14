"""Which pages are generated, wholly or between two marks."""

import re
from pathlib import Path

from shearloop.daemon.docgen.messages_page import messages_page
from shearloop.daemon.docgen.troubleshooting_page import safety_table, troubleshooting_page

ROOT = Path(__file__).resolve().parents[2]
_MARKED = re.compile(r"(<!-- generated: safety table -->\n).*?(<!-- end -->)", re.DOTALL)


def pages(root: Path) -> dict[Path, str]:
    """Return each page's path and what it should say."""
    safety = root / "docs/safety.md"
    return {
        root / "docs/messages.md": messages_page(root),
        root / "docs/troubleshooting.md": troubleshooting_page(root),
        safety: _MARKED.sub(
            lambda match: f"{match[1]}\n{safety_table()}\n\n{match[2]}", safety.read_text(encoding="utf-8")
        ),
    }
