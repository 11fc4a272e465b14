"""CURVE on anything but loopback and ipc, keys by `shearloop keys`, an allow-list, and no way round them."""

import asyncio
import ipaddress
import os
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
import yaml
import zmq
import zmq.asyncio

from shearloop.cli import main
from shearloop.daemon.messaging import stop_client
from shearloop.daemon.messaging.addresses import has_valid_port, is_local, needs_keys
from shearloop.daemon.messaging.bound_sockets import bind
from shearloop.daemon.messaging.client import Subscriber
from shearloop.daemon.messaging.keys import (
    ClientKeys,
    KeyPair,
    allowed_clients,
    check_allowed_clients,
    load_key_pair,
    load_public_key,
    load_server_keys,
)
from shearloop.daemon.messaging.messages import decode, encode
from shearloop.daemon.messaging.stop_client import send_to_stop_socket
from shearloop.errors import UserError
from tests.fixtures.daemons import DEADLINE_S, of_now, running_daemon

NETWORK = "tcp://0.0.0.0:*"
# How long somebody is waited for who is not to be heard.
SILENCE_MS = 300


def curve(folder: Path) -> dict[str, str]:
    return {"server_key": str(folder / "keys/server.key_secret"), "clients": str(folder / "keys/clients")}


def ada(folder: Path) -> ClientKeys:
    return ClientKeys.load(folder / "ada/client.key_secret", folder / "keys/server.key")


def test_local_and_network_addresses():
    for address in ("tcp://127.0.0.1:1", "tcp://[::1]:1", "ipc:///run/x", "ipc://@x"):
        assert is_local(address), address
    for address in ("tcp://0.0.0.0:1", "tcp://*:1", "tcp://10.0.0.1:1", "tcp://pc:1", "tcp://127.0.0.1:1;0.0.0.0:2"):
        assert not is_local(address), address
    assert not needs_keys("tcp://localhost:1")
    assert needs_keys("tcp://pc:1")


def test_valid_ports():
    for address in ("tcp://127.0.0.1:1", "tcp://[::1]:65535", "tcp://0.0.0.0:*", "ipc:///run/x", "ipc://@x:70000"):
        assert has_valid_port(address), address
    for port in ("65536", "70000", "0000070000", "7761a", "-1", "", "²", "1" * 5000):
        assert not has_valid_port(f"tcp://127.0.0.1:{port}"), port
    assert not has_valid_port("tcp://127.0.0.1")
    with zmq.Context() as context, pytest.raises(UserError, match=r"has no valid port \(a whole number"):
        bind(context.socket(zmq.PUB), "tcp://127.0.0.1:70000", "publish")


@pytest.mark.parametrize("command", ["run", "check"])
def test_a_network_address_needs_keys(command, config, mistake):
    for key in ("publish", "commands"):
        assert f"`{key}: tcp://0.0.0.0:7769` would open the robot to the network" in mistake(
            command, config(**{key: "tcp://0.0.0.0:7769"})
        )


def test_a_network_address_needs_existing_keys(config, keys, ran, mistake):
    missing = {"server_key": str(keys / "none.key_secret"), "clients": str(keys / "keys/clients")}
    path = str(config(commands=NETWORK, curve=missing))
    for command in ("run", "check"):
        cure = f"on the daemon's computer, `shearloop keys server --dir {keys}` makes the daemon's keys"
        assert cure in mistake(command, path)
    ran("keys", "revoke", "ada", "--dir", keys / "keys")
    said = mistake("run", config(commands=NETWORK, curve=curve(keys)))
    assert "holds no key, so no client could connect" in said
    assert f"allow one with `shearloop keys allow FILE --dir {keys / 'keys'}`" in said


def test_check_names_the_allowed_clients_and_files_that_are_no_keys(config, keys, ran):
    junk = keys / "keys/clients/junk.key"
    junk.write_text("no key\n")
    said = ran("check", config(commands=NETWORK, curve=curve(keys))).out
    assert f"ada may connect; {junk} is no key file; " in said


@pytest.fixture
def connect() -> Iterator[Callable[..., "zmq.asyncio.Socket"]]:
    with zmq.asyncio.Context() as context:
        sockets = []

        def connected(kind: int, address: str, client: ClientKeys | None) -> "zmq.asyncio.Socket":
            socket = context.socket(kind)
            sockets.append(socket)
            socket.setsockopt(zmq.LINGER, 0)
            if client is not None:
                client.apply(socket)
            if kind == zmq.SUB:
                socket.setsockopt(zmq.SUBSCRIBE, b"")
            socket.connect(address)
            return socket

        yield connected
        for socket in sockets:
            socket.close()


def reachable(address: str) -> str:
    return address.replace("//0.0.0.0:", "//127.0.0.1:")


async def test_only_allowed_clients_connect_and_only_encrypted(config, keys, connect, monkeypatch):
    monkeypatch.setattr("shearloop.daemon.messaging.client.QUIET_S", 0.02)
    path = config(publish=NETWORK, commands=NETWORK, curve=curve(keys))
    async with running_daemon(path) as daemon:
        commands = reachable(daemon.tasks["commands"].address)
        published = reachable(daemon.publisher.address)
        known = ada(keys)
        asking = connect(zmq.DEALER, commands, known)
        await asking.send(encode({"command": "status"}))
        assert decode(await asking.recv())["ok"]
        with Subscriber(published, keys=known, timeout_s=DEADLINE_S) as subscriber:
            topic, _ = await anext(subscriber)
        assert topic == "health"
        strangers = {
            "in the clear": None,
            "a key that is not allowed": ClientKeys(KeyPair(*zmq.curve_keypair()), known.server_public),
            "a server that is not ours": ClientKeys(known.own, zmq.curve_keypair()[0]),
        }
        for who, stranger in strangers.items():
            asking, hearing = connect(zmq.DEALER, commands, stranger), connect(zmq.SUB, published, stranger)
            await asking.send(encode({"command": "status"}))
            assert not await asking.poll(SILENCE_MS), who
            assert not await hearing.poll(0), who
            told = "does not publish to this client" if stranger is None else "this client: your key is not allowed"
            in_vain = pytest.raises(UserError, match=told)
            with Subscriber(published, keys=stranger, timeout_s=0.01) as subscriber, in_vain:
                await anext(subscriber)
            # Without a time it waits, and says why.
            quiet: asyncio.Future[str] = asyncio.get_running_loop().create_future()
            with Subscriber(published, keys=stranger, on_quiet=quiet.set_result) as subscriber:
                waiting = asyncio.ensure_future(anext(subscriber))
                sentence = await quiet
                waiting.cancel()
                await asyncio.gather(waiting, return_exceptions=True)
            cause = "it answers only with keys" if stranger is None else "your key is not allowed (`sudo shearloop keys"
            assert f"waiting. Is a daemon running there? If one is, {cause}" in sentence, who
        assert daemon.health.tasks()["commands"]["errors"]["key is not allowed"] >= 1
        anyone = partial(asyncio.to_thread, send_to_stop_socket, commands)
        for name in ("start", "resume", "unlock", "tare", "pause"):
            assert "this command needs a key" in (await anyone({"command": name}, DEADLINE_S))["reason"]
        assert (await anyone({"command": "stop", **of_now()}, DEADLINE_S))["ok"]
        await daemon.ending.wait()


async def test_a_loopback_address_of_a_daemon_that_is_open_to_the_network_needs_keys_too(
    config, keys, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    own = tmp_path / "shearloop"
    path = config(publish=NETWORK, commands=NETWORK, curve=curve(keys))
    async with running_daemon(path) as daemon:
        commands = reachable(daemon.tasks["commands"].address)
        published = reachable(daemon.publisher.address)

        async def told(*arguments: str) -> tuple[int, str]:
            status = await asyncio.to_thread(main, list(arguments))
            return status, capsys.readouterr().err

        pause = ("command", "pause", "--connect", commands)
        heard = ("listen", "health", "--count", "1", "--timeout", "20", "--connect", published)
        for command, address in ((pause, commands), (heard, published)):
            status, said = await told(*command)
            assert status == 2
            assert f"the daemon at {address} is open to the network and answers only with keys" in said
            assert f"there is no key {own / 'client.key_secret'}: make one" in said
        own.mkdir()
        for file in (keys / "ada/client.key_secret", keys / "keys/server.key"):
            shutil.copy(file, own)
        status, said = await told(*pause)
        assert (status, "no robot" in said) == (1, True)
        assert (await told(*heard))[0] == 0
        (keys / "keys/clients/ada.key").unlink()
        status, said = await told(*pause, "--timeout", "0.5")
        assert status == 2
        assert "a program listens there: if it is the daemon, your key is not allowed" in said


def test_a_daemon_at_the_network_address_alone_is_named(monkeypatch, mistake):
    listeners = [(ipaddress.ip_address("192.0.2.7"), 7769, 0)]
    monkeypatch.setattr(stop_client, "_listeners", lambda: iter(listeners))
    for command in (("command", "pause"), ("listen", "health")):
        said = mistake(*command, "--connect", "tcp://127.0.0.1:7769", "--timeout", "0.01")
        assert "a program of this computer listens at tcp://192.0.2.7:7769" in said


def test_a_client_needs_keys_for_another_machine(tmp_path, monkeypatch, ran, mistake):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    for command in (["listen"], ["command", "stop"]):
        assert "make one with `shearloop keys client`" in mistake(*command, "--connect", "tcp://192.0.2.1:7761")
    ran("keys", "client")
    assert "copy the daemon's server.key there" in mistake("listen", "--connect", "tcp://192.0.2.1:7761")


def test_keys_are_made_listed_and_revoked(keys, ran, mistake, result_of):
    folder = keys / "keys"
    assert (folder / "server.key_secret").stat().st_mode & 0o777 == 0o600
    assert (folder / "clients/ada.key").stat().st_mode & 0o777 == 0o644
    shown = result_of("keys", "list", "--dir", folder)
    assert shown["clients"] == {"ada": load_public_key(keys / "ada/client.key", "").decode()}
    for arguments, why in (
        (["server"], "exists already"),
        (["allow", str(keys / "ada/client.key"), "--name", "eve"], "is allowed already, as ada"),
        (["allow", str(folder / "server.key"), "--name", "../eve"], "is not a client's name"),
        (["allow", str(folder / "server.key")], "server.key is the daemon's own key: allow the client.key"),
        (["revoke", "eve"], "there is no client 'eve'; the allowed clients are ada"),
    ):
        assert why in mistake("keys", *arguments, "--dir", folder)
    assert result_of("keys", "revoke", "ada", "--dir", folder) == {"revoked": "ada"}
    advice = f"no client may connect yet; allow one with `shearloop keys allow FILE --dir {folder}`"
    assert advice in ran("keys", "list", "--dir", folder).out


def test_the_cure_of_a_clients_files_makes_no_key_of_another_daemon(keys, mistake):
    """On the client's computer, `keys server` would make keys that no daemon has."""
    own, server = keys / "ada/client.key_secret", keys / "keys/server.key"
    missing, damaged = keys / "none", keys / "damaged"
    damaged.write_text("no key")
    for key, server_key, cure in (
        (missing, server, "make one with `shearloop keys client`"),
        (damaged, server, "make one with `shearloop keys client`"),
        (own, missing, "copy the daemon's server.key there"),
        (own, damaged, "copy the daemon's server.key there"),
    ):
        with pytest.raises(UserError) as raised:
            ClientKeys.load(key, server_key)
        said = mistake("listen", "--key", key, "--server-key", server_key)
        for sentence in (str(raised.value), said):
            assert cure in sentence
            assert "keys server" not in sentence


def test_a_folder_is_no_key(keys):
    with pytest.raises(UserError, match=r"the key cannot be read: it is a folder; name a file in it$"):
        ClientKeys.load(keys, keys / "keys/server.key")


def test_a_secret_key_is_taken_for_no_public_one(keys, mistake, result_of):
    """It never leaves its computer, and the folder of allowed clients is readable by every user."""
    made = keys / "eve"
    secret = Path(result_of("keys", "client", "--dir", made)["secret_file"])
    said = f"{secret} holds a secret key, which never leaves its computer: give the file that ends in .key"
    assert said in mistake("keys", "allow", secret, "--name", "eve", "--dir", keys / "keys")
    assert not (keys / "keys/clients/eve.key").exists()
    (keys / "keys/clients/eve.key").write_text(secret.read_text())
    clients = allowed_clients(keys / "keys/clients")
    assert list(clients.names.values()) == ["ada"]
    assert "eve.key holds a secret key" in clients.unusable[0]
    with pytest.raises(UserError, match=r"server\.key_secret holds a secret key"):
        ClientKeys.load(keys / "ada/client.key_secret", keys / "keys/server.key_secret")


def test_keys_of_the_daemon_are_made_on_its_computer(tmp_path, keys, mistake):
    """Somebody may type these on a client's computer."""
    client, none = keys / "ada/client.key", tmp_path / "none"
    on_its_computer = f"on the daemon's computer, `shearloop keys server --dir {none}` makes"
    for arguments in (["allow", client], ["revoke", "ada"], ["list"]):
        assert on_its_computer in mistake("keys", *arguments, "--dir", none)
    said = mistake("keys", "allow", none, "--dir", keys / "keys")
    assert "take the client.key that `shearloop keys client` has made on the client's computer" in said


def test_a_daemon_of_another_computer_is_started_there(keys):
    """Nobody answers at this address (RFC 5737)."""
    with (
        Subscriber("tcp://192.0.2.1:7761", timeout_s=0.01, keys=ada(keys)) as subscriber,
        pytest.raises(UserError, match="start it on its computer with `shearloop run CONFIG`") as raised,
    ):
        next(subscriber)
    assert "`sudo shearloop keys allow FILE` on the daemon's computer" in str(raised.value)


def test_the_paths_of_keys_are_whole(ran, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "own/keys"
    said = ran("keys", "server", "--dir", "own/keys").out
    assert f"curve: {{server_key: {folder}/server.key_secret, clients: {folder}/clients}}" in said
    assert f"`shearloop keys allow FILE --dir {folder}`" in said
    said = ran("keys", "client", "--dir", "mine").out
    assert "add `--dir` with their folder" in said
    assert f"server.key back to {tmp_path}/mine/server.key" in said


def test_the_printed_section_of_a_configuration_can_be_copied(tmp_path, ran):
    folder = tmp_path / "my rig, its keys: {one}"
    folder.mkdir()
    (line,) = (one for one in ran("keys", "server", "--dir", folder).out.splitlines() if one.startswith("curve: "))
    server, clients = str(folder / "server.key_secret"), str(folder / "clients")
    assert yaml.safe_load(line) == {"curve": {"server_key": server, "clients": clients}}


def test_a_damaged_key_is_an_error(keys):
    secret = keys / "keys/server.key_secret"
    other = KeyPair(*zmq.curve_keypair())
    for text, part in (
        ("", "is no key file"),
        ('public-key = "short"\n', "damaged key"),
        (f'public-key = "{other.public.decode()}"\n', "holds no secret key"),
        (secret.read_text().replace(load_key_pair(secret, "").public.decode(), other.public.decode()), "do not match"),
    ):
        secret.write_text(text)
        with pytest.raises(UserError, match=part):
            load_key_pair(secret, "")


def test_a_systemd_credential_replaces_the_key_file(keys, tmp_path, monkeypatch):
    handed = tmp_path / "handed"
    handed.mkdir()
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(handed))
    secret = keys / "keys/server.key_secret"
    (handed / secret.name).write_text(secret.read_text())
    (handed / secret.name).chmod(0o400)
    assert load_server_keys(Path("/etc/shearloop/keys/server.key_secret")) == load_key_pair(secret, "")
    (handed / secret.name).chmod(0o600)
    (handed / secret.name).write_text("none")
    with pytest.raises(UserError, match="run `sudo shearloop keys server`"):
        load_server_keys(Path("/etc/shearloop/keys/server.key_secret"))


def test_repr_hides_the_secret_key():
    pair = KeyPair(*zmq.curve_keypair())
    assert pair.secret.decode() not in repr(pair)


def test_a_file_that_is_no_key_locks_out_nobody(keys, ran, result_of):
    clients = keys / "keys" / "clients"
    (clients / "junk.key").write_bytes(b"\xff\x00 no key")
    (clients / "large.key").write_text("#" * 100_000)
    os.mkfifo(clients / "pipe.key")
    found = check_allowed_clients(clients)
    assert list(found.names.values()) == ["ada"]
    assert [Path(why.partition(":")[0].partition(" ")[0]).stem for why in found.unusable] == ["junk", "large", "pipe"]
    assert set(result_of("keys", "list", "--dir", keys / "keys")["clients"]) == {"ada"}
    assert "junk.key is no key file" in ran("keys", "list", "--dir", keys / "keys").out
    (clients / "ada.key").unlink()
    with pytest.raises(UserError, match=r"junk\.key is no key file.*so no client could connect"):
        check_allowed_clients(clients)


def test_a_secret_key_that_every_user_can_read_is_named(keys):
    secret = (keys / "keys").rename(keys / "my keys") / "server.key_secret"
    secret.chmod(0o644)
    with pytest.raises(UserError, match=r"every user of this machine can read the secret key: run `chmod 600 '"):
        load_key_pair(secret, "")
    secret.chmod(0o600)
    assert load_key_pair(secret, "").public == load_public_key(keys / "my keys" / "server.key", "")
