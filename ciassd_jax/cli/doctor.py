"""`ciassd doctor`: whether this machine and this installation can run the package."""

from __future__ import annotations

from dataclasses import dataclass

from ciassd_jax.inference import self_checks
from ciassd_jax.inference.programs import keep_programs


@dataclass(frozen=True)
class Doctor:
    """Check this machine and this installation: versions, devices, memory, disk, cache, workers, a forward pass.

    Ends with one verdict. The exit code is 1 if a check failed.
    """

    def run(self) -> int:
        keep_programs()
        failed = []
        for name, check in self_checks.CHECKS.items():
            found = self_checks.run_check(check)
            for state, text in found:
                print(f"{state:<4}  {name:<8}  {text}", flush=True)
            if any(one.state == "FAIL" for one in found):
                failed.append(name)
        print(f"Not ready; failed: {', '.join(failed)}." if failed else "Ready: every check passed.")
        return int(bool(failed))
