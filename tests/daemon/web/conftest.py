"""A browser, a viewer as a process of its own, and a daemon's sockets before it, for the tests of the page."""

import json
import os
import select
import shutil
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, sync_playwright
from playwright.sync_api import TimeoutError as PlaywrightTimeoutError

from tests.daemon.web.forked import Forks
from tests.fixtures.daemons import DEADLINE_S

CHROMIUM_ARGUMENTS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)


# Where things are once the page is scrolled to its end.
LAYOUT = """() => {
  const box = (element) => element.getBoundingClientRect().toJSON();
  const seen = (selector) => [...document.querySelectorAll(selector)].filter((element) => element.offsetParent);
  window.scrollTo(0, document.body.scrollHeight);
  return {
    wide: document.documentElement.scrollWidth - document.documentElement.clientWidth,
    stop: box(document.querySelector('#stop')),
    panels: seen('.panel').map(box),
    buttons: seen('button').map(box),
    spilt: seen('.panel').filter((panel) => panel.scrollWidth > panel.clientWidth + 1).map((panel) => panel.className),
  };
}"""


# Counts the answers to requests to a path, each once the page has dealt with it: a task runs after the promises.
COUNT_ANSWERS = """(path) => {
  window.answers = 0;
  const real = window.fetch;
  window.fetch = async (url, options) => {
    const response = await real(url, options);
    const json = response.json.bind(response);
    response.json = async () => {
      const content = await json();
      if (String(url).startsWith(path)) setTimeout(() => { window.answers += 1; });
      return content;
    };
    return response;
  };
}"""


class Killable:
    """A process that a test kills and starts again."""

    _pid: int | None = None

    def __init__(self, folder: Path, forks: Forks) -> None:
        self._folder, self._forks = folder, forks

    def kill(self) -> None:
        if self._pid is not None:
            self._forks.kill(self._pid)
            self._pid = None

    @contextmanager
    def standing_still(self) -> Iterator[None]:
        """Let the process stand still, and continue."""
        assert self._pid is not None
        os.kill(self._pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(self._pid, signal.SIGCONT)


class FakeDaemon(Killable):
    """The sockets of a daemon, in a process that can be killed."""

    def __init__(self, folder: Path, forks: Forks) -> None:
        super().__init__(folder, forks)
        self.publish, self.commands = f"ipc://{folder}/publish", f"ipc://{folder}/commands"
        self.forget()

    def say(
        self,
        *,
        refusal: str = "",
        digest: str = "a",
        drops: bool = False,
        lists: bool = True,
        **changed: Mapping[str, Any] | None,
    ) -> None:
        """Say all messages from now on, with changes to some; None takes one out. Refuse commands where told so.

        `digest` is of the questions; `drops`: an unlock drops a tool, and asks; `lists`: it has a list of experiments.
        """
        new = self._folder / "changed.new"
        told = {"refusal": refusal, "digest": digest, "drops": drops, "lists": lists}
        new.write_text(json.dumps({"messages": changed, **told}))
        new.rename(self._folder / "changed")

    @property
    def asked(self) -> list[str]:
        """The commands that came, in order."""
        return (self._folder / "asked").read_text().splitlines()

    def forget(self) -> None:
        (self._folder / "asked").write_text("")

    def start(self) -> None:
        if self._pid is None:
            self._pid = self._forks.start("daemon", str(self._folder))

    def check(self) -> None:
        assert self._pid is None or self._forks.runs(self._pid), "the daemon's sockets have died"


class Viewer(Killable):
    """`shearloop view` as a process of its own, on a port that it keeps when it is started again."""

    def __init__(self, folder: Path, forks: Forks, daemon: FakeDaemon) -> None:
        super().__init__(folder, forks)
        self._daemon, self._said = daemon, folder / "said"
        self._port = 0
        self.url = self.url_with_token = ""
        os.mkfifo(self._said)

    def start(self) -> None:
        # It says its address, in one line, and nothing else.
        with open(os.open(self._said, os.O_RDONLY | os.O_NONBLOCK), "rb") as said:
            self._pid = self._forks.start(
                *("view", "--json", "--port", str(self._port)),
                *("--connect", self._daemon.publish, "--commands", self._daemon.commands),
                *("--token-file", str(self._folder / "token")),
                output=self._said,
            )
            ready, _, _ = select.select([said], [], [], DEADLINE_S)
            assert ready, f"the viewer has not said its address within {DEADLINE_S} s"
            line = said.readline()
        assert line, "the viewer has ended before it said its address"
        printed = json.loads(line)
        self.url, self.url_with_token = printed["url"], printed["url_with_token"]
        self._port = int(self.url.rstrip("/").rpartition(":")[2])


class Browsed:
    """One page in a browser, with everything around it that a test moves."""

    def __init__(self, page: Page, daemon: FakeDaemon, viewer: Viewer) -> None:
        self.page, self.daemon, self.viewer = page, daemon, viewer
        self.complaints: list[str] = []
        self.hosts: set[str] = set()
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", lambda line: self.complaints.append(line.text) if line.type == "error" else None)
        page.on("request", lambda request: self.hosts.add(request.url.split("/")[2]))

    def open(self, *, token: bool = False) -> Page:
        """Open the page anew, with or without the token, and wait until it is live."""
        self.daemon.check()
        self.page.goto("about:blank")
        self.page.goto(self.viewer.url_with_token if token else self.viewer.url)
        if not token and self.page.evaluate("sessionStorage.length"):
            self.page.evaluate("sessionStorage.clear()")
            self.page.reload()
        self.until("#link-state", "● live")
        return self.page

    @contextmanager
    def answered(self, path: str) -> Iterator[None]:
        """At the end of the block, wait until the page has dealt with the answer to a request of it to this path."""
        self.page.evaluate(COUNT_ANSWERS, path)
        yield
        self.page.wait_for_function("() => window.answers > 0")

    def layout(self) -> dict[str, Any]:
        """Return where things are once the page is scrolled to its end."""
        return self.page.evaluate(LAYOUT)

    def text(self, selector: str) -> str:
        """Return the text of one element."""
        return self.page.inner_text(selector)

    def until(self, selector: str, text: str) -> None:
        """Wait until an element has a text in it."""
        self.page.wait_for_function(
            "([selector, text]) => document.querySelector(selector)?.textContent.includes(text)", arg=[selector, text]
        )

    def until_shown(self, shown: Mapping[str, str]) -> None:
        """Wait until elements have these texts, all at one moment; where they never have, tell the difference."""
        texts = (
            "(shown) => Object.fromEntries(Object.keys(shown).map((s) => [s, document.querySelector(s)?.innerText]))"
        )
        equal = f"(shown) => Object.entries(({texts})(shown)).every(([s, text]) => text === shown[s])"
        try:
            self.page.wait_for_function(equal, arg=dict(shown))
        except PlaywrightTimeoutError:
            assert self.page.evaluate(texts, dict(shown)) == shown

    def until_complete(self) -> None:
        """Wait until every message is shown: a panel whose message comes late could not become old."""
        self.page.wait_for_function(
            """() => !document.querySelector('#shear').hidden && document.querySelector('.fingertip:not([hidden])') &&
              ['torque-now', 'diameter', 'speed-sent', 'phase-name'].every(
                (id) => document.getElementById(id).textContent !== '–')"""
        )

    def until_old(self, count: int) -> None:
        """Wait until so many panels are marked as old."""
        self.page.wait_for_function("n => document.querySelectorAll('.panel.old').length === n", arg=count)

    def until_all_old(self) -> None:
        """Wait until every panel is marked as old, but for what has happened. How many depends on the tests before."""
        self.page.wait_for_function(
            "() => document.querySelectorAll('.panel:not([hidden]):not(.old):not(#happened)').length === 0"
        )


@pytest.fixture
def fresh(browsed) -> Iterator[None]:
    """Every test begins with all messages, and ends without a complaint of the browser or a call to elsewhere."""
    browsed.daemon.say()
    browsed.daemon.forget()
    browsed.daemon.start()
    browsed.complaints.clear()
    yield
    unexpected = [line for line in browsed.complaints if not line.startswith("Failed to load resource")]
    unexpected = [line for line in unexpected if "WebSocket connection to" not in line]
    assert unexpected == []
    assert browsed.hosts <= {browsed.viewer.url.split("/")[2]}


@pytest.fixture(scope="module")
def browsed(tmp_path_factory) -> Iterator[Browsed]:
    """A page before a viewer before a daemon's sockets: one browser for all tests of a module."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("needs Debian's chromium: `make system-packages` installs it")
    folder = tmp_path_factory.mktemp("view")
    forks = Forks()
    daemon = FakeDaemon(folder, forks)
    viewer = Viewer(folder, forks, daemon)
    daemon.say()
    daemon.start()
    try:
        viewer.start()
        with sync_playwright() as playwright:
            context = playwright.chromium.launch_persistent_context(
                folder / "profile",
                executable_path=chromium,
                headless=True,
                args=CHROMIUM_ARGUMENTS,
                viewport={"width": 1024, "height": 700},
            )
            context.set_default_timeout(DEADLINE_S * 1000)
            yield Browsed(context.pages[0], daemon, viewer)
            context.close()
    finally:
        forks.close()
