"""The files of the service, held against systemd's own tools and a small reading of udev's rules."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from shearloop.daemon.config import load_daemon_config
from shearloop.errors import UserError
from shearloop.tools.service import PLACES, UNIT, hidden_folder, service_file, unit_for

ROOT = Path(__file__).resolve().parents[3]
# Any program will do for systemd to look at; that the service may see ours is find_program's business.
PROGRAM = Path("/usr/bin/true")


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("systemd-analyze is not on this machine; `make system-packages` installs it")


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "real-time"])
def unit(request, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("unit") / UNIT
    path.write_text(unit_for(PROGRAM))
    if request.param:
        drop_in = path.with_name(f"{UNIT}.d") / "realtime.conf"
        drop_in.parent.mkdir()
        drop_in.write_text(service_file("realtime.conf"))
    return path


def test_the_unit_runs_the_program_given(unit):
    assert f"ExecStart={PROGRAM} run /etc/shearloop/shearloop.yaml\n" in unit.read_text()


def test_systemd_accepts_the_unit(unit):
    done = analyze("verify", str(unit))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("name", ["a b", "100%n", "a$b", "a;b", "ü", "-a  b"])
def test_systemd_accepts_the_path_of_the_program(name, tmp_path):
    folder = tmp_path / name
    folder.mkdir()
    program = folder / "shearloop"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    path = tmp_path / UNIT
    path.write_text(unit_for(program))
    done = analyze("verify", str(path))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("sign", ["'", '"', "\\", "\n"])
def test_a_sign_that_systemd_refuses_is_named(sign):
    with pytest.raises(UserError, match=re.escape(f"has {sign!r} in its path, which systemd refuses")):
        unit_for(Path(f"/opt/a{sign}b/shearloop"))


def test_systemd_reports_a_wrong_unit(tmp_path):
    path = tmp_path / UNIT
    path.write_text(unit_for(PROGRAM).replace("WatchdogSec=15", "WatchdogSec=often"))
    assert "Failed to parse sec value" in analyze("verify", str(path)).stderr


def test_the_service_is_exposed_at_most_2_of_10(unit):
    done = analyze("security", "--offline=true", "--threshold=20", "--no-pager", str(unit))
    assert done.returncode == 0, done.stdout
    exposure = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert float(exposure[1]) <= 2.0


def test_the_example_is_a_configuration(tmp_path):
    path = tmp_path / "shearloop.yaml"
    path.write_text(service_file("shearloop.yaml"))
    assert load_daemon_config(path).fingertips["right"].device.serial_number


def test_folders_hidden_by_the_unit_are_known():
    assert "ProtectHome=yes" in service_file(UNIT)
    assert "PrivateTmp=yes" in service_file(UNIT)
    for path, folder in (("/home/ada/venv/bin/shearloop", "/home"), ("/root/x", "/root"), ("/tmp/x", "/tmp")):
        assert hidden_folder(Path(path)) == folder
    assert hidden_folder(Path("/opt/shearloop/bin/shearloop")) == ""


def test_a_wheel_carries_every_file_of_the_service_and_of_the_page(tmp_path):
    build = "from setuptools import build_meta; import sys; print(build_meta.build_wheel(sys.argv[1]))"
    source = tmp_path / "source"
    source.mkdir()
    # From a copy: building writes beside the sources.
    subprocess.run(
        ["sh", "-c", f"git ls-files -z -co --exclude-standard | tar cf - --null -T - | tar xf - -C {source}"],
        cwd=ROOT,
        check=True,
    )
    subprocess.run([sys.executable, "-c", build, str(tmp_path)], cwd=source, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    with zipfile.ZipFile(wheel) as archive:
        assert "-py3-none-any" in wheel.name
        assert {name.split("/")[0] for name in archive.namelist()} == {
            "shearloop",
            f"shearloop-{project['version']}.dist-info",
        }
        for path in (path.relative_to(ROOT) for path in (ROOT / "config").rglob("*.*")):
            assert f"shearloop/{path}" in archive.namelist()
        assert "shearloop/py.typed" in archive.namelist()
        for name in (*PLACES, "realtime.conf", "shearloop.yaml"):
            assert archive.read(f"shearloop/systemd/{name}").decode() == service_file(name)
        assets = sorted((ROOT / "daemon" / "web" / "assets").iterdir())
        assert {"index.html", "app.js", "uPlot.LICENSE.txt"} <= {path.name for path in assets}
        for path in assets:
            assert archive.read(f"shearloop/daemon/web/assets/{path.name}") == path.read_bytes()


# ---- udev ---------------------------------------------------------------------------------------------------------

_TERM = re.compile(r'([A-Z]+(?:\{\w+\})?)(==|!=|\+=|=)"([^"]*)"(?:, |$)')


def applied(rules: str, device: dict[str, str]) -> dict[str, str]:
    """Return what udev(7) would assign to a device: matches, GOTO and LABEL, and plain assignments."""
    given: dict[str, str] = {}
    wanted = ""
    for line in rules.splitlines():
        if not line or line.startswith("#"):
            continue
        terms = _TERM.findall(line)
        assert "".join(f'{key}{sign}"{value}", ' for key, sign, value in terms).removesuffix(", ") == line
        if wanted:
            wanted = "" if ("LABEL", "=", wanted) in terms else wanted
            if wanted:
                continue
        matches = [(key, sign, value) for key, sign, value in terms if sign in ("==", "!=")]
        if all((device.get(key, "") in value.split("|")) == (sign == "==") for key, sign, value in matches):
            for key, sign, value in terms:
                if key == "GOTO":
                    wanted = value
                elif sign in ("=", "+=") and key != "LABEL":
                    given[key] = re.sub(r"\$(env\{\w+\})", lambda name: device.get(name[1].upper(), ""), value)
    assert not wanted, f"there is no LABEL {wanted}"
    return given


TEENSY = {
    "ACTION": "add",
    "SUBSYSTEM": "tty",
    "ENV{ID_BUS}": "usb",
    "ENV{ID_VENDOR_ID}": "16c0",
    "ENV{ID_SERIAL_SHORT}": "12345670",
    "ENV{ID_PATH}": "pci-0000:00:14.0-usb-0:2:1.0",
}


@pytest.mark.parametrize("vendor", ["16c0", "2341", "2a03", "1a86", "0403"])
def test_boards_are_linked_by_serial_number_and_owned_by_the_service(vendor):
    given = applied(service_file("60-shearloop.rules"), {**TEENSY, "ENV{ID_VENDOR_ID}": vendor})
    assert given == {
        "GROUP": "shearloop",
        "MODE": "0660",
        "SYMLINK": "shearloop/12345670",
        "ENV{ID_MM_DEVICE_IGNORE}": "1",
    }


@pytest.mark.parametrize("vendor", ["16c0", "2341", "2a03", "1a86", "0403"])
@pytest.mark.parametrize("path", [TEENSY["ENV{ID_PATH}"], ""])
def test_boards_without_a_serial_number_are_the_services_too_and_linked_by_socket(vendor, path):
    copy = {"ENV{ID_VENDOR_ID}": vendor, "ENV{ID_SERIAL_SHORT}": "", "ENV{ID_PATH}": path}
    given = applied(service_file("60-shearloop.rules"), {**TEENSY, **copy})
    link = {"SYMLINK": f"shearloop/{path}"} if path else {}
    assert given == {"GROUP": "shearloop", "MODE": "0660", "ENV{ID_MM_DEVICE_IGNORE}": "1", **link}


@pytest.mark.parametrize(
    "other", [{"ACTION": "remove"}, {"SUBSYSTEM": "block"}, {"ENV{ID_BUS}": "pci"}, {"ENV{ID_VENDOR_ID}": "046d"}]
)
def test_other_devices_are_ignored(other):
    assert applied(service_file("60-shearloop.rules"), {**TEENSY, **other}) == {}
