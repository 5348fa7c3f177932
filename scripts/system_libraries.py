"""Check the shared libraries that some Python wheels expect of the system, and install them where possible.

Only the standard library is used, so that it runs before anything is installed. As root with apt-get
the missing packages are installed; otherwise the exact command is printed. It always exits with 0: runs can
be checked, read and used for training without these libraries.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys

# Library file -> (who needs it, the Debian and Ubuntu packages that carry it, newest name first).
LIBRARIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "libX11.so.6": ("sapien", ("libx11-6",)),
    "libGL.so.1": ("opencv, which sapien imports", ("libgl1",)),
    "libgthread-2.0.so.0": ("opencv, which sapien imports", ("libglib2.0-0t64", "libglib2.0-0")),
    "libgomp.so.1": ("pinocchio", ("libgomp1",)),
}


def missing_libraries() -> list[str]:
    """The libraries of `LIBRARIES` that the dynamic loader cannot open."""
    missing: list[str] = []
    for name in LIBRARIES:
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    return missing


def _apt_knows(package: str) -> bool:
    """Whether apt can install the package. Virtual names are listed without a version, so look for one."""
    shown = subprocess.run(
        ["apt-cache", "policy", package], capture_output=True, text=True, check=False
    ).stdout
    return any(line.strip().startswith("Candidate:") and "(none)" not in line for line in shown.splitlines())


def packages_for(libraries: list[str]) -> list[str]:
    """The apt packages of the libraries: the first name each that this system's apt offers."""
    chosen: list[str] = []
    for library in libraries:
        names = LIBRARIES[library][1]
        offered = [name for name in names if _apt_knows(name)]
        package = offered[0] if offered else names[-1]
        if package not in chosen:
            chosen.append(package)
    return chosen


def install_command(packages: list[str]) -> str:
    """The shell command that installs the packages."""
    prefix = "" if os.geteuid() == 0 else "sudo "
    return (
        f"{prefix}apt-get update && {prefix}apt-get install -y --no-install-recommends {' '.join(packages)}"
    )


def _install() -> bool:
    """Run apt-get update and install the missing packages; False when apt-get failed."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}

    def succeeds(*arguments: str) -> bool:
        command = ["apt-get", *arguments]
        return not subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=False).returncode

    # Which package names exist is known only after the update.
    return succeeds("update", "-q") and succeeds(
        "install", "-y", "-q", "--no-install-recommends", *packages_for(missing_libraries())
    )


def main() -> int:
    """Check the libraries, install them where possible, and report the missing ones."""
    if sys.platform != "linux":
        return 0
    missing = missing_libraries()
    has_apt = shutil.which("apt-get") is not None
    if missing and has_apt and os.geteuid() == 0:
        print("installing system libraries: " + ", ".join(missing), flush=True)
        if not _install():
            print("apt-get failed; continuing without them", file=sys.stderr)
        missing = missing_libraries()
    if not missing:
        return 0
    for name in missing:
        print(f"missing {name}, needed by {LIBRARIES[name][0]}", file=sys.stderr)
    if has_apt:
        print("install them with: " + install_command(packages_for(missing)), file=sys.stderr)
    else:
        print("install them with this system's package manager", file=sys.stderr)
    print("until then labels need the settler pybullet, an extra (settle.engine)", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
