"""The disk, kernel and initramfs of the guest that hardware tests run in: built once, then cached.

A stock Debian kernel with the virtual cameras vivid and v4l2loopback, and a minimal Debian with systemd, udev and the
daemon's own dependencies in the versions that are installed here. Build it by `python -m tests.hardware.image` (root,
network, a few minutes); a cached image needs neither.
"""

from __future__ import annotations

import hashlib
import lzma
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOTFS = Path(__file__).with_name("rootfs")
RECIPE = 1  # raise it when the functions below build another image from the same constants
SUITE = "bookworm"
PACKAGES = (
    *("systemd", "systemd-sysv", "udev", "dbus", "libnss-systemd"),
    *("python3", "v4l-utils", "kmod", "procps", "busybox-static"),
)
GUEST_MODULES = ("v4l2loopback", "vivid", "uvcvideo", "vhci-hcd", "softdog", "9p", "9pnet_virtio", "autofs4")
BOOT_MODULES = ("virtio_pci", "virtio_blk", "ext4", "crc32c_generic", "9pnet_virtio", "9p")
# Units that only delay a guest without a screen, a time server or a second boot.
MASKED = (
    *("systemd-timesyncd.service", "systemd-logind.service", "systemd-random-seed.service"),
    *("systemd-update-utmp.service", "systemd-update-utmp-runlevel.service", "systemd-remount-fs.service"),
    *("systemd-pcrphase.service", "systemd-pcrphase-sysinit.service", "apt-daily.timer", "apt-daily-upgrade.timer"),
    *("dpkg-db-backup.timer", "e2scrub_all.timer", "e2scrub_reap.service", "fstrim.timer", "getty.target"),
    *("getty@tty1.service", "serial-getty@ttyS0.service"),
)
BUILD_TOOLS = ("mmdebstrap", "mke2fs", "depmod", "cpio", "make", "busybox", "gcc-12", "xz")


class ImageUnavailableError(Exception):
    """The image does not exist and cannot be built here; the message names what to install or to run."""


class BuildError(Exception):
    """A step of the build failed."""


def image() -> Path:
    """Return the folder of the image for this kernel, these dependencies and this recipe, cached or built now.

    It holds what QEMU starts: vmlinux, unpacked, since the emulator would need seconds for that; initramfs.cpio, which
    mounts the disk; and root.ext4, of which guests write to a snapshot. Raises ImageUnavailableError where it is
    neither cached nor can be built.
    """
    _require("qemu-system-x86_64")
    pins, kernel = pinned(), kernel_package()
    folder = cache_folder() / f"{kernel.removeprefix('linux-image-')}-{_digest(pins)}"
    if not (folder / "root.ext4").exists():
        _require(*BUILD_TOOLS)
        if os.geteuid() != 0:
            raise ImageUnavailableError(
                f"no image in {cache_folder()}: build it once by `sudo {sys.executable} -m tests.hardware.image`"
            )
        _build(folder, kernel, pins)
    return folder


def cache_folder() -> Path:
    """Return $OMNID_VM_CACHE, else omnid-vm in the user's cache folder."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("OMNID_VM_CACHE") or caches / "omnid-vm")


def pinned() -> list[str]:
    """Return the daemon's dependencies, and pytest, in the versions installed here."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    names = [re.split(r"[^\w.-]", entry)[0] for entry in project["dependencies"]] + ["pytest"]
    return sorted(f"{name}=={version(name)}" for name in names)


def kernel_package() -> str:
    """Return the package that linux-image-amd64 depends on, or the cached one where apt does not know it."""
    known = _run("apt-cache", "depends", "linux-image-amd64", check=False) if shutil.which("apt-cache") else ""
    names = re.findall(r"Depends: (linux-image-[\w.-]+)", known)
    names += [f"linux-image-{path.parent.name.rpartition('-')[0]}" for path in cache_folder().glob("*/root.ext4")]
    if not names:
        raise ImageUnavailableError("apt knows no linux-image-amd64: run `apt-get update` on a Debian machine")
    return names[0]


def _digest(pins: Iterable[str]) -> str:
    """Return eight letters that change with the content of the image."""
    digest = hashlib.sha256(repr((RECIPE, *pins, PACKAGES, GUEST_MODULES, BOOT_MODULES, MASKED)).encode())
    for path in sorted(path for path in ROOTFS.rglob("*") if path.is_file()):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def _require(*tools: str) -> None:
    missing = [tool for tool in tools if shutil.which(tool) is None]
    if missing:
        raise ImageUnavailableError(f"missing programs: {' '.join(missing)}")


def _build(folder: Path, kernel: str, pins: list[str]) -> None:
    """Build in a temporary folder and rename it, so that an aborted build leaves no incomplete image."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="build-", dir=folder.parent) as name:
        work = Path(name)
        work.chmod(0o755)
        release = kernel.removeprefix("linux-image-")
        tree = _kernel_tree(work, kernel, release)
        _write_root(work / "root", tree, release, pins)
        (work / "image").mkdir()
        _write_initramfs(work, tree, release)
        _run("mke2fs", "-q", "-t", "ext4", "-O", "^has_journal", "-d", work / "root", work / "image/root.ext4", "3G")
        (work / "image/vmlinux").write_bytes(_unpacked((tree / f"boot/vmlinuz-{release}").read_bytes()))
        (work / "image").rename(folder)


def _kernel_tree(work: Path, kernel: str, release: str) -> Path:
    """Unpack the kernel's packages and build v4l2loopback with its headers; return the folder."""
    debs, tree = work / "debs", work / "kernel"
    debs.mkdir()
    common = release.rsplit("-", 1)[0]
    major_minor = ".".join(release.split(".")[:2])
    packages = [kernel, f"linux-headers-{release}", f"linux-headers-{common}-common", f"linux-kbuild-{major_minor}"]
    packages += ["linux-compiler-gcc-12-x86", "v4l2loopback-dkms"]
    _run("apt-get", "-q", "download", *packages, cwd=debs)
    for deb in debs.iterdir():
        _run("dpkg", "-x", deb, tree)
    headers = tree / f"usr/src/linux-headers-{release}"
    makefile = headers / "Makefile"  # includes the common headers by their installed path
    makefile.write_text(makefile.read_text("utf-8").replace("/usr/src/", f"{tree}/usr/src/"), "utf-8")
    source = next((tree / "usr/src").glob("v4l2loopback-*"))
    _run("make", "-s", "-C", headers, f"M={source}", "modules")
    extra = tree / f"lib/modules/{release}/extra"
    extra.mkdir()
    shutil.copy(source / "v4l2loopback.ko", extra)
    _run("strip", "-g", extra / "v4l2loopback.ko")
    _run("depmod", "-b", tree, release)
    return tree


def _write_root(root: Path, tree: Path, release: str, pins: list[str]) -> None:
    _run("mmdebstrap", "-q", "--variant=minbase", f"--include={','.join(PACKAGES)}", SUITE, root, _apt_sources())
    packages = root / "usr/local/lib/python3.11/dist-packages"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--only-binary=:all:", "--python-version", "3.11"]
    _run(*pip, "--no-compile", "--root-user-action=ignore", "--target", packages, *pins)
    _run("chroot", root, "python3", "-m", "compileall", "-q", packages.relative_to(root), check=False)
    for module in _with_needed(tree, release, GUEST_MODULES):
        target = root / module.relative_to(tree)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(module, target)
    for listing in (tree / f"lib/modules/{release}").glob("modules.[ob]*"):
        shutil.copy(listing, root / f"lib/modules/{release}")
    _run("depmod", "-b", root, release)
    shutil.copytree(ROOTFS, root, dirs_exist_ok=True, ignore=shutil.ignore_patterns("init"))
    for name in MASKED:
        (root / "etc/systemd/system" / name).symlink_to("/dev/null")
    (root / "mnt" / "job").mkdir()
    (root / "etc/machine-id").write_text("0123456789abcdef0123456789abcdef\n", "ascii")


def _write_initramfs(work: Path, tree: Path, release: str) -> None:
    """Write busybox, the drivers of the disk in the order of their dependencies, and `init`."""
    initramfs = work / "initramfs"
    for name in ("bin", "proc", "sys", "dev", "mnt", "modules"):
        (initramfs / name).mkdir(parents=True)
    shutil.copy(shutil.which("busybox") or "/bin/busybox", initramfs / "bin/busybox")
    shutil.copy(ROOTFS / "init", initramfs / "init")
    (initramfs / "init").chmod(0o755)
    modules = list(_with_needed(tree, release, BOOT_MODULES))
    for module in modules:
        shutil.copy(module, initramfs / "modules")
    (initramfs / "modules/order").write_text("".join(f"{module.name}\n" for module in modules), "ascii")
    names = "\n".join(str(path.relative_to(initramfs)) for path in [initramfs, *sorted(initramfs.rglob("*"))])
    with open(work / "image/initramfs.cpio", "wb") as archive:
        subprocess.run(
            ["cpio", "-o", "-H", "newc", "--quiet"], cwd=initramfs, input=names.encode(), stdout=archive, check=True
        )


def _with_needed(tree: Path, release: str, names: Iterable[str]) -> Iterator[Path]:
    """Return the files of the modules, each after its dependencies, without duplicates."""
    seen: dict[Path, None] = {}
    for name in names:
        lines = _run("modprobe", "-d", tree, "-S", release, "--show-depends", name).splitlines()
        seen |= {Path(line.split()[1]): None for line in lines if line.startswith("insmod")}
    return iter(seen)


def _apt_sources() -> str:
    """Return this machine's apt sources, so that a mirror configured here is used."""
    places = [Path("/etc/apt/sources.list"), *sorted(Path("/etc/apt/sources.list.d").glob("*.sources"))]
    return next((str(path) for path in places if path.is_file() and path.stat().st_size), "")


def _unpacked(kernel: bytes) -> bytes:
    """Return the ELF file in a bzImage, which QEMU starts by its PVH entry."""
    elf = lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(kernel[kernel.index(b"\xfd7zXZ\0") :])
    if not elf.startswith(b"\x7fELF"):
        raise BuildError("the kernel is not packed by xz as Debian's is")
    return elf


def _run(*command: object, cwd: Path | None = None, check: bool = True) -> str:
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False)
    if check and done.returncode:
        raise BuildError(f"{' '.join(words)[:200]} ended with {done.returncode}: {done.stderr.strip()[-500:]}")
    return done.stdout


if __name__ == "__main__":
    print(image())
