"""`shearloop emulate ur`: what its user can get wrong, told in a sentence."""

import pytest

from shearloop.daemon.cli import main


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--version", "five"], "--version five is no version"),
        (["--rate-hz", "5"], "--rate-hz 5 is outside 50 to 1000"),
        # An address for documentation (RFC 5737), which no machine has.
        (["--host", "192.0.2.1"], "cannot listen on 192.0.2.1"),
    ],
)
def test_mistakes_are_told(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["emulate", "ur", *arguments]) == 2
    assert said in capsys.readouterr().err
