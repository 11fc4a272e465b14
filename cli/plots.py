"""What commands do before they draw with matplotlib."""

import logging

from shearloop.extras import require


def require_matplotlib(what: str) -> None:
    """Raise UserError unless matplotlib is installed, which draws `what`; call it before anything imports it.

    With a home that cannot be written it would log two paragraphs on its own folders, before the result of a command.
    """
    require("matplotlib", "plot", what)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
