"""A small virtual machine with Debian's ordinary kernel, in which tests meet the kernel's simulated video devices.

Nothing is installed: the kernel's package is unpacked into a cache folder, an initramfs of a few files is made, and the
machine's root is this host's own root, read-only by 9p with a memory file system laid over it. So the tests run in the
guest with the very environment that runs them here. It needs no KVM, and uses it where it can be opened.
"""

from __future__ import annotations

import fcntl
import gzip
import io
import json
import lzma
import os
import platform
import re
import shlex
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.support.requirements import ROOT

CACHE = ROOT / ".cache" / "guest"
_PYTEST = (sys.executable, "-m", "pytest", "-p", "pytest_timeout", "-p", "tests.support.guest_report")
#: the modules that are loaded, in this order, each after what it depends on
_MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "vivid", "vhci_hcd", "uvcvideo")
# Three devices: two webcams, of which the second has the multi-planar interface, and an HDMI input that can cut out
# regions, with a television input beside it that is interlaced. Only their capture nodes.
_VIVID = "n_devs=3 node_types=1,1,1 multiplanar=1,2,1 num_inputs=1,1,2 input_types=0,0,7 ccs_cap_mode=-1,-1,1"
_MEMORY = "1536M"
_WORD = b"guest: here"
# with KVM it is there after a second or two; where /dev/kvm opens and carries nothing, it is only waited for
_WORD_S = 6.0
_ACCELERATORS = {"kvm": ("-accel", "kvm", "-cpu", "max,arch-capabilities=off"), "tcg": ("-accel", "tcg", "-cpu", "max")}

_INIT = """#!/bin/busybox sh
B=/bin/busybox
$B mkdir -p /proc /sys /dev /host /fresh /root
$B mount -t proc proc /proc
$B mount -t sysfs sysfs /sys
$B mount -t devtmpfs devtmpfs /dev
$B echo "guest: here"
while read -r file options; do
    $B insmod "/modules/$file" $options || echo "guest: $file was not loaded"
done < /modules/order
$B mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=524288 host /host || echo "guest: no host"
$B mount -t tmpfs -o size=60% tmpfs /fresh
$B mkdir -p /fresh/upper /fresh/work
$B mount -t overlay -o lowerdir=/host,upperdir=/fresh/upper,workdir=/fresh/work overlay /root || echo "guest: no root"
$B mkdir -p /root/run/report
$B mount -t 9p -o trans=virtio,version=9p2000.L,cache=none report /root/run/report || echo "guest: no report"
for folder in proc sys dev; do $B mount --move /$folder /root/$folder; done
$B mkdir -p /root/dev/shm
$B mount -t tmpfs tmpfs /root/dev/shm
$B ifconfig lo 127.0.0.1 up
$B chroot /root /bin/sh /run/report/run
$B poweroff -f
"""


class Missing(Exception):
    """Something that the guest needs is not installed; the text names it."""


@dataclass
class Outcome:
    """What became of one test in the guest."""

    outcome: str = "lost"  # passed, failed, skipped; lost when the guest ended first
    text: str = ""
    output: str = ""
    seconds: float = 0.0


@dataclass
class Report:
    """Results of the guest."""

    outcomes: dict[str, Outcome] = field(default_factory=dict)
    serial: str = ""
    seconds: float = 0.0

    @property
    def tail(self) -> str:
        """The end of what came out of the guest's serial line."""
        return "\n".join(self.serial.splitlines()[-60:])


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _run(*command: str, cwd: Path | None = None) -> str:
    try:
        return subprocess.run(command, cwd=cwd, check=True, capture_output=True, text=True, timeout=300).stdout
    except FileNotFoundError as error:
        raise Missing(f"the program {command[0]}") from error
    except subprocess.CalledProcessError as error:
        raise Missing(f"what `{' '.join(command)}` would bring ({error.stderr.strip()[-300:]})") from error


def _kernel_folder() -> Path:
    """Unpack Debian's kernel package once and return the folder that it lies in."""
    package = os.environ.get("STEREORIG_GUEST_KERNEL", "")
    if not package:
        known = sorted(CACHE.glob("linux-image-*/done"))
        if known:
            return known[-1].parent
        match = re.search(r"Depends: (linux-image-[\w.+-]+)", _run("apt-cache", "depends", "linux-image-amd64"))
        if match is None:
            raise Missing("Debian's package linux-image-amd64 in apt's lists (apt-get update)")
        package = match.group(1)
    folder = CACHE / package
    if not (folder / "done").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        try:
            _run("apt-get", "download", "-q", package, cwd=folder)
        except Missing:  # apt's lists may be older than the newest kernel
            _run("apt-get", "update", "-q")
            _run("apt-get", "download", "-q", package, cwd=folder)
        (deb,) = folder.glob("*.deb")
        _run("dpkg", "-x", deb.name, "tree", cwd=folder)
        deb.unlink()
        (folder / "done").touch()
    return folder


def _module_files(modules: Path, names: Sequence[str]) -> list[Path]:
    """Return the files of these modules, each after those that it depends on."""
    files = {file.name.split(".ko")[0].replace("-", "_"): file for file in modules.rglob("*.ko*")}
    order: list[Path] = []

    def add(name: str) -> None:
        file = files.get(name.replace("-", "_"))
        if file is None or file in order:
            return  # built in, or here already
        found = re.search(rb"\0depends=([^\0]*)\0", b"\0" + _plain(file))
        for other in found.group(1).decode().split(",") if found else []:
            if other:
                add(other)
        order.append(file)

    for name in names:
        add(name)
    return order


def _plain(module: Path) -> bytes:
    content = module.read_bytes()
    return lzma.decompress(content) if module.suffix == ".xz" else content


def _archive(files: dict[str, bytes]) -> bytes:
    """Write a cpio archive as the kernel takes it for its first root ("newc"), compressed."""
    out = io.BytesIO()

    def entry(name: str, mode: int, content: bytes) -> None:
        numbers = (0, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
        out.write(b"070701" + "".join(f"{number:08x}" for number in numbers).encode())
        for part in (name.encode() + b"\0", content):
            out.write(part)
            out.write(bytes(-out.tell() % 4))

    for folder in sorted({part for name in files for part in map(str, Path(name).parents) if part != "."}):
        entry(folder, 0o040755, b"")
    for name, content in files.items():
        entry(name, 0o100755, content)
    entry("TRAILER!!!", 0, b"")
    return gzip.compress(out.getvalue(), 1)


def _needs_loader(program: bytes) -> bool:
    """Whether an ELF file names a loader for shared libraries (a header of type 3)."""
    (at,) = struct.unpack_from("<Q", program, 32)
    size, count = struct.unpack_from("<HH", program, 54)
    return any(struct.unpack_from("<I", program, at + n * size) == (3,) for n in range(count))


def _first_root(folder: Path) -> bytes:
    busybox = shutil.which("busybox")
    if busybox is None or _needs_loader(Path(busybox).read_bytes()):
        raise Missing("a busybox without shared libraries (Debian: busybox-static)")
    (modules,) = (folder / "tree" / "lib" / "modules").iterdir()
    order = _module_files(modules, _MODULES)
    files = {"init": _INIT.encode(), "bin/busybox": Path(busybox).read_bytes()}
    lines = []
    for file in order:
        name = file.name.split(".ko")[0]
        files[f"modules/{name}.ko"] = _plain(file)
        lines.append(f"{name}.ko {_VIVID if name == 'vivid' else ''}")
    files["modules/order"] = ("\n".join(lines) + "\n").encode()
    return _archive(files)


def run_in_guest(tests: Sequence[str], folder: Path, *, limit_s: float, arguments: Sequence[str] = ()) -> Report:
    """Boot, run pytest on these test files, and return what became of each test.

    Parameters
    ----------
    tests
        Paths from the repository's root.
    folder
        An empty folder for the guest's report and serial log; its path must not contain commas.
    limit_s
        The machine is killed after this time, and its tests that had not ended are lost.
    arguments
        More for pytest.

    Raises
    ------
    Missing
        When QEMU, busybox or the kernel's package cannot be had.
    """
    begin = time.monotonic()
    if platform.machine() not in ("x86_64", "AMD64"):
        raise Missing("an x86-64 machine, whose programs the guest runs")
    qemu = shutil.which("qemu-system-x86_64")
    if qemu is None:
        raise Missing("qemu-system-x86_64 (Debian: qemu-system-x86)")
    if shutil.which("v4l2-ctl") is None:  # what the tests in the guest compare with
        raise Missing("v4l2-ctl (Debian: v4l-utils)")
    with _one_at_a_time():
        kernel = _kernel_folder()
    first_root = folder / "initramfs"
    first_root.write_bytes(_first_root(kernel))
    report = folder / "report"
    report.mkdir()
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "pytest_timeout",
        "-p",
        "tests.support.guest_report",
        "-p",
        "no:cacheprovider",
    ]
    environment = {
        "STEREORIG_V4L2_GUEST": "1",
        "GUEST_REPORT": "/run/report/outcomes",
        "PYTHONPATH": str(ROOT),
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # fewer files to fetch through 9p
        "PATH": os.environ.get("PATH", "/usr/bin:/bin"),
        "CI": os.environ.get("CI", ""),
        "HOME": "/root",
        "TMPDIR": "/run",
    }
    lines = [f"export {name}={_quoted(value)}" for name, value in environment.items()]
    lines += [f"cd {_quoted(str(ROOT))}", " ".join(map(_quoted, [*command, "-q", "-rN", *arguments, *tests]))]
    (report / "run").write_text("\n".join(lines) + "\n")
    (vmlinuz,) = (kernel / "tree" / "boot").glob("vmlinuz-*")
    machine = [qemu, "-nodefaults", "-display", "none", "-no-reboot", "-m", _MEMORY, "-smp", "1"]
    machine += ["-kernel", str(vmlinuz), "-initrd", str(first_root)]
    machine += ["-append", "console=ttyS0 loglevel=4 panic=-1 mitigations=off random.trust_cpu=on"]
    machine += ["-serial", f"file:{folder / 'serial'}"]
    share = "security_model=none,multidevs=remap"
    machine += [
        "-fsdev",
        f"local,id=host,path=/,readonly=on,{share}",
        "-device",
        "virtio-9p-pci,fsdev=host,mount_tag=host",
    ]
    machine += ["-fsdev", f"local,id=report,path={report},{share}"]
    machine += ["-device", "virtio-9p-pci,fsdev=report,mount_tag=report"]
    for accelerator in _accelerators():
        if _runs(
            [*machine, *_ACCELERATORS[accelerator]], folder, limit_s, _WORD_S if accelerator == "kvm" else limit_s
        ):
            break
        if accelerator == "kvm":
            (CACHE / "without_kvm").touch()
    return _report_of(folder, time.monotonic() - begin)


def _accelerators() -> list[str]:
    """Those to try, the fastest first; what failed here once is not tried again."""
    if "STEREORIG_GUEST_ACCEL" in os.environ:
        return [os.environ["STEREORIG_GUEST_ACCEL"]]
    kvm = os.access("/dev/kvm", os.R_OK | os.W_OK) and not (CACHE / "without_kvm").exists()
    return ["kvm", "tcg"] if kvm else ["tcg"]


def _runs(machine: list[str], folder: Path, limit_s: float, word_s: float) -> bool:
    """Run the machine to its end; False when it had printed nothing after ``word_s``.

    /dev/kvm may open and still not carry a guest: inside another virtual machine it may hang in its first instructions.
    """
    begin = time.monotonic()
    serial = folder / "serial"
    serial.write_text("")
    with (folder / "qemu").open("a") as log:
        process = subprocess.Popen(machine, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            while process.poll() is None:
                spent = time.monotonic() - begin
                if spent > limit_s or (spent > word_s and _WORD not in serial.read_bytes()):
                    log.write(f"killed after {spent:.0f} s\n")
                    break
                time.sleep(0.2)
        finally:
            process.kill()
            process.wait()
    return _WORD in serial.read_bytes()


def _report_of(folder: Path, seconds: float) -> Report:
    made = Report(seconds=seconds)
    outcomes = folder / "report" / "outcomes"
    for line in outcomes.read_text(encoding="utf-8").splitlines() if outcomes.is_file() else []:
        fields = json.loads(line)
        name = fields.pop("name")
        made.outcomes[name] = Outcome(**fields)
    made.serial = (folder / "serial").read_text(errors="replace") + (folder / "qemu").read_text()
    return made


def _quoted(text: str) -> str:
    return shlex.quote(text)


def collect(tests: Sequence[str]) -> list[tuple[str, list[tuple[str, list[object]]]]]:
    """Names of the tests that the guest would run, each with its marks, in their order."""
    environment = {
        **os.environ,
        "STEREORIG_V4L2_GUEST": "1",
        "GUEST_COLLECT": "1",
        "PYTHONPATH": str(ROOT),
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
    }
    for name in [name for name in environment if name.startswith(("PYTEST_XDIST", "PYTEST_CURRENT", "PYTEST_ADDOPTS"))]:
        del environment[name]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "--collect-only",
        "-q",
        "-p",
        "pytest_timeout",
        "-p",
        "tests.support.guest_report",
    ]
    done = subprocess.run([*command, *tests], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    for line in done.stdout.splitlines():
        if line.startswith("GUEST "):
            return [(name, marks) for name, marks in json.loads(line[6:])]
    raise RuntimeError(f"the guest's tests cannot be collected:\n{done.stdout}\n{done.stderr}")
