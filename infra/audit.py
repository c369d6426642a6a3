"""Known vulnerabilities of the pinned packages, by pip-audit; part of `make lint`. Without a network it says so."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

PINS = Path(__file__).resolve().parents[1] / "constraints.txt"
#: Where pip-audit looks advisories up.
SERVICE = "https://pypi.org/pypi/pip/json"


def reachable(url: str, timeout_s: float = 5.0) -> bool:
    """Whether the service answers."""
    try:
        with urllib.request.urlopen(url, timeout=timeout_s):  # nosec B310 # the constant above
            return True
    except (OSError, urllib.error.URLError):
        return False


def verdict(document: dict[str, Any]) -> tuple[list[str], int]:
    """What pip-audit's JSON says, in lines, and the exit code: 1 where a pinned package has a known vulnerability.

    A package that the service does not know (a mirror has no advisories) is not one without vulnerabilities.
    """
    packages = document["dependencies"]
    skipped = [package["name"] for package in packages if "skip_reason" in package]
    lines = [
        f"{package['name']} {package['version']}: {found['id']}, mended in {', '.join(found['fix_versions']) or 'none'}"
        for package in packages
        for found in package.get("vulns", [])
    ]
    failed = bool(lines)
    lines.append(f"{len(packages) - len(skipped)} of {len(packages)} pinned packages were looked up.")
    if skipped:
        lines.append(f"Nothing is known of {', '.join(skipped[:5])}{' and others' * (len(skipped) > 5)}.")
    return lines, int(failed)


def main() -> int:
    """1 where a pinned package has a known vulnerability; 0 where none has, or nobody can be asked, which is said."""
    if not reachable(SERVICE):
        print(f"Known vulnerabilities were not looked up: {SERVICE} cannot be reached from here.")
        return 0
    command = [sys.executable, "-m", "pip_audit", "--requirement", str(PINS), "--no-deps", "--disable-pip"]
    done = subprocess.run([*command, "--progress-spinner", "off", "--format", "json"], capture_output=True, text=True)
    try:
        lines, code = verdict(json.loads(done.stdout))
    except ValueError:
        lines, code = [f"Known vulnerabilities were not looked up: {done.stderr.strip()[-300:]}"], 0
    print("\n".join(lines))
    return code


if __name__ == "__main__":
    sys.exit(main())
