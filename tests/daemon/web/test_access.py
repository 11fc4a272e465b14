import os
import stat
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.errors import UserError
from shearloop.daemon.web.server import (
    WRONG_BURST,
    TokenCheck,
    default_token_path,
    host_allowed,
    load_token,
    origin_allowed,
    token_valid,
)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:7760", "localhost:9000", "LOCALHOST:1", "[::1]:7760"])
def test_loopback_hosts_are_allowed_on_any_port(host):
    assert host_allowed(host)


@pytest.mark.parametrize(
    "host",
    [
        *(None, "", "evil.example", "127.0.0.1.evil.example:7760", "evil.example@127.0.0.1", "localhost.evil.example"),
        *("192.168.1.5:7760", "0.0.0.0:7760", "127.0.0.1:99999", "[::1", "127.0.0.1/@evil.example", "127.0.0.1:x"),
    ],
)
def test_foreign_hosts_are_refused(host):
    assert not host_allowed(host)


@given(st.text(max_size=40))
def test_any_host_header_gives_a_boolean(host):
    assert isinstance(host_allowed(host), bool)


def test_foreign_origins_are_refused():
    assert origin_allowed(None, "127.0.0.1:7760")
    assert origin_allowed("http://127.0.0.1:7760", "127.0.0.1:7760")
    for origin in (
        "null",
        "",
        "http://127.0.0.1:7761",
        "https://127.0.0.1:7760",
        "http://localhost:7760",
        "http://a.b",
    ):
        assert not origin_allowed(origin, "127.0.0.1:7760"), origin


def test_only_the_complete_token_is_valid():
    assert token_valid("Bearer abc", "abc")
    for header in (None, "", "abc", "Bearer", "Bearer ", "Bearer ab", "Bearer abcd", "Basic abc", "Bearer äbc"):
        assert not token_valid(header, "abc"), header


def test_the_token_is_made_once_and_readable_by_its_owner_only(tmp_path):
    path = tmp_path / "state" / "shearloop" / "view-token"
    token = load_token(path)
    assert len(token) >= 43
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_token(path) == token
    assert load_token(path, new=True) != token


def test_readable_or_invalid_token_files_are_refused(tmp_path):
    path = tmp_path / "token"
    load_token(path)
    path.chmod(0o640)
    with pytest.raises(UserError, match="nobody else may read"):
        load_token(path)
    for content in ("", "short", "x" * 500, "a token with spaces in it, long enough as it is"):
        path.write_text(content)
        path.chmod(0o600)
        with pytest.raises(UserError, match="holds no token"):
            load_token(path)


def test_links_and_pipes_are_refused_as_token_files(tmp_path):
    load_token(tmp_path / "other")
    (tmp_path / "link").symlink_to(tmp_path / "other")
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name, why in (("link", "cannot be kept"), ("pipe", "must be a file")):
        with pytest.raises(UserError, match=why):
            load_token(tmp_path / name)


def test_the_default_token_path_follows_xdg(monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    assert default_token_path() == Path("/state/shearloop/view-token")
    monkeypatch.setenv("XDG_STATE_HOME", "not/absolute")
    monkeypatch.setenv("HOME", "/home/somebody")
    assert default_token_path() == Path("/home/somebody/.local/state/shearloop/view-token")


def test_guessing_the_token_is_slowed_to_one_try_per_second():
    tokens, guesses = TokenCheck("abc"), 1000
    statuses = [tokens.refusal("start", f"Bearer {number}", number * 1_000_000)[0] for number in range(guesses)]
    assert Counter(statuses) == {403: WRONG_BURST, 429: guesses - WRONG_BURST}, "1000 guesses in a second"
    assert tokens.refusal("start", "Bearer abc", 999_000_000)[0] == 429, "the right one waits too"
    assert tokens.refusal("start", "Bearer abc", 3 * 10**9) is None
    assert tokens.refusal("start", "Bearer abc", 3 * 10**9) is None, "the right one is never counted"
