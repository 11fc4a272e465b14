"""The file of a report during a commissioning: no other one writes it, and each error says which stages it has."""

import errno
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from shearloop.daemon.commissioning_report import Report, stage_number
from shearloop.errors import UserError
from shearloop.files import sole_writer
from shearloop.tools.commission.report import PAGE_BEGINS, earlier_report, page_path, write_page, write_report
from shearloop.tools.outputs import check_overwrite, check_place


@dataclass(slots=True)
class ReportFile:
    """The report's path, the report on the disk, and the stage that is being measured."""

    path: Path
    written: Report | None
    _measuring: str = ""
    # The end of the cure: the option with which `commission` continues here.
    _continues: str = ""

    @classmethod
    @contextmanager
    def opened(cls, path: Path) -> Iterator[Self]:
        """Yield the file, and keep other commissionings from writing it.

        Raises UserError where report or page cannot be written, or would replace a file of another kind.
        """
        check_place(path)
        with _sole(path):
            written = earlier_report(path)
            check_overwrite(page_path(path), "the page of a report", PAGE_BEGINS)
            yield cls(path, written)

    def begin(self, stage: str, remaining: Sequence[str] = ()) -> None:
        """Remember which stage is measured; `remaining` are the figures of the named stages from here on, if any."""
        self._measuring = stage
        self._continues = f" with `--stages {''.join(remaining)}`" if remaining else ""

    def save(self, report: Report, unmeasured: Sequence[str] = ()) -> Path:
        """Write the report and its page, and return the page's path; raises UserError with the file that failed."""
        write_report(self.path, report)
        self.written, self._measuring = report, ""
        return write_page(self.path, report, unmeasured)

    @contextmanager
    def saying_what_is_kept(self) -> Iterator[None]:
        """Add to every exception of the block what the report holds, and how to continue."""
        try:
            yield
        except BaseException as error:
            error.add_note(self._kept())
            raise

    def _kept(self) -> str:
        again = f"{self._holds()}. Run it again{self._continues} to continue"
        if not self._measuring:
            return again
        number = stage_number(self._measuring)
        has_earlier = self.written is not None and self.written.stage(number) is not None
        until = ", and has its earlier result until then" if has_earlier else ""
        return f"{again}: stage {self._measuring} is measured again from its beginning{until}"

    def _holds(self) -> str:
        if self.written is None:
            return f"Nothing is written: {self.path} does not exist"
        stages = [stage.stage for stage in self.written.stages]
        if not stages:
            return f"{self.path} has no stage"
        return f"{self.path} has the stage{'s' if len(stages) > 1 else ''} {', '.join(stages)}"


@contextmanager
def _sole(path: Path) -> Iterator[None]:
    """Keep other commissionings from writing a report, by a locked file in its folder that is removed at the end."""
    report = path.resolve()
    locked = report.with_name(f"{report.name}.lock")
    with ExitStack() as opened:
        try:
            opened.enter_context(sole_writer(locked))
        except OSError as error:
            if error.errno == errno.EBUSY:
                raise UserError(
                    f"another `shearloop commission` writes the report {path}: wait for its end, or choose another "
                    "--out"
                ) from error
            raise UserError(f"{path}: the report cannot be written: {error.strerror}; choose another --out") from error
        try:
            yield
        finally:
            # It is still locked: the next commissioning makes its own.
            with suppress(OSError):
                locked.unlink()
