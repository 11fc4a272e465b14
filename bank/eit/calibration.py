"""From the place of the best match to physical units: σ to torque by a parabola, k to diameter by a line.

Trehan et al. 2025, section 2 and figures 8 and 9. A calibration belongs to one bank and one channel table, and says of
every k and σ whether it was made for them. The file is YAML, for reading; its checksum keeps hands and cut cables off.
"""

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import yaml

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH
from shearloop.bank.eit.polynomial import Interval, Polynomial
from shearloop.bank.eit.stored import check_made_with, check_version
from shearloop.bank.errors import CalibrationError
from shearloop.files import replace_file

FORMAT_VERSION = 1
TORQUE_DEGREE, DIAMETER_DEGREE = 2, 1

_KIND = "shearloop calibration"
_HEAD = "# Made by shearloop: sigma and k in cm, torque in N·m, diameter in mm. Do not edit; calibrate again instead.\n"


@dataclass(frozen=True, slots=True)
class Calibration:
    """What a bank's k and σ mean on one fingertip; either fit may be missing.

    torque_fit is torque in N·m over σ in cm, diameter_fit diameter in mm over k in cm; bank_identity is the bank's
    that k and σ are places in; source says in words what they were fitted to.
    """

    bank_identity: str
    source: str
    torque_fit: Polynomial | None
    diameter_fit: Polynomial | None
    channel_table_hash: str = CHANNEL_TABLE_HASH

    @classmethod
    def fit(
        cls,
        bank_identity: str,
        source: str,
        *,
        torque: tuple[FloatArray, FloatArray] | None = None,
        diameter: tuple[FloatArray, FloatArray] | None = None,
    ) -> Self:
        """Fit torque = (σ (n,), torque_nm (n,)) and diameter = (k (n,), diameter_mm (n,)), as far as they are given.

        Raises CalibrationError when both are missing, or do not determine their curves.
        """
        if torque is None and diameter is None:
            raise CalibrationError("a calibration needs measurements of torque, of diameter, or of both")
        return cls(
            bank_identity=bank_identity,
            source=source,
            torque_fit=None if torque is None else Polynomial.fit(*torque, TORQUE_DEGREE),
            diameter_fit=None if diameter is None else Polynomial.fit(*diameter, DIAMETER_DEGREE),
        )

    def torque(self, sigma: float) -> Interval:
        """Return the torque in N·m at σ with its 95 % prediction interval; CalibrationError where none was fitted."""
        return _fitted(self.torque_fit, "torque").interval(sigma)

    def diameter(self, k: float) -> Interval:
        """Return the diameter in mm at k with its 95 % prediction interval; CalibrationError where none was fitted."""
        return _fitted(self.diameter_fit, "diameter").interval(k)

    def out_of_range(self, k: float, sigma: float) -> tuple[str, ...]:
        """Return the reasons why k and σ lie outside of what was calibrated: an estimate from them is not valid.

        Only what was fitted is judged. The limits themselves are inside.
        """
        judged = (("sigma", sigma, self.torque_fit, "torque"), ("k", k, self.diameter_fit, "diameter"))
        return tuple(
            f"{name} = {x:.4g} cm is outside of {fit.x_low:.4g} to {fit.x_high:.4g} cm, where {what} was calibrated"
            for name, x, fit, what in judged
            if fit is not None and not fit.x_low <= x <= fit.x_high
        )

    def save(self, path: str | Path) -> None:
        """Write the calibration over what was there.

        Equal calibrations are equal bytes. Raises CalibrationError where the file cannot be written.
        """
        path = Path(path)
        body = self._body()
        text = _HEAD + _yaml(body | {"checksum": _checksum(body)})
        try:
            with replace_file(path) as file:
                file.write(text.encode())
        except OSError as error:
            raise CalibrationError(
                f"{path}: the calibration cannot be written: {error.strerror}; choose another place"
            ) from error

    @classmethod
    def load(cls, path: str | Path, *, bank_identity: str | None = None) -> Self:
        """Read a calibration; with `bank_identity`, only one that was made with this bank.

        Raises CalibrationError for a file that is missing, truncated, edited, foreign, or made with another bank or
        channel table.
        """
        path = Path(path)
        made_with = {"channel_table_hash": CHANNEL_TABLE_HASH}
        if bank_identity is not None:
            made_with["bank_identity"] = bank_identity
        body = _read_body(path)
        check_made_with(path, body, made_with)
        try:
            return cls(
                bank_identity=str(body["bank_identity"]),
                source=str(body["source"]),
                torque_fit=_polynomial(body["torque"]),
                diameter_fit=_polynomial(body["diameter"]),
                channel_table_hash=str(body["channel_table_hash"]),
            )
        except (KeyError, TypeError, ValueError, CalibrationError) as error:
            raise CalibrationError(
                f"{path}: the file does not describe a calibration ({error!r}); calibrate again"
            ) from error

    def _body(self) -> dict[str, Any]:
        return {
            "kind": _KIND,
            "format_version": FORMAT_VERSION,
            "source": self.source,
            "bank_identity": self.bank_identity,
            "channel_table_hash": self.channel_table_hash,
            "torque": _mapping(self.torque_fit),
            "diameter": _mapping(self.diameter_fit),
        }


def _fitted(fit: Polynomial | None, what: str) -> Polynomial:
    if fit is None:
        raise CalibrationError(f"the calibration has no fit for {what}: it was made without measurements of it")
    return fit


def _mapping(fit: Polynomial | None) -> dict[str, Any] | None:
    if fit is None:
        return None
    return asdict(fit) | {"coefficients": list(fit.coefficients), "spread": [list(row) for row in fit.spread]}


def _polynomial(mapping: dict[str, Any] | None) -> Polynomial | None:
    if mapping is None:
        return None
    return Polynomial(
        **mapping
        | {
            "coefficients": tuple(map(float, mapping["coefficients"])),
            "spread": tuple(tuple(map(float, row)) for row in mapping["spread"]),
        }
    )


def _read_body(path: Path) -> dict[str, Any]:
    """Return what the file says, once its kind, version and checksum are as they should be."""
    try:
        found = yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise CalibrationError(f"{path}: the calibration cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: this is not YAML, so no calibration; calibrate again") from error
    if not isinstance(found, dict) or found.get("kind") != _KIND:
        raise CalibrationError(f"{path}: this is not a calibration: expected a file with `kind: {_KIND}`")
    check_version(path, found, FORMAT_VERSION)
    checksum = found.pop("checksum", None)
    if checksum != _checksum(found):
        raise CalibrationError(
            f"{path}: the calibration is truncated or was edited: its checksum is not {str(checksum)[:12]}…; "
            "restore it from a copy, or calibrate again"
        )
    return found


def _checksum(body: dict[str, Any]) -> str:
    return hashlib.sha256(_yaml(body).encode()).hexdigest()


def _yaml(mapping: dict[str, Any]) -> str:
    text: str = yaml.safe_dump(mapping, sort_keys=False, allow_unicode=True, width=120)
    return text
