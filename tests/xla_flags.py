"""How XLA compiles in tests."""

import jaxlib


def xla_flags(devices: int, level: int | None = None) -> str:
    """The value of XLA_FLAGS for a number of CPU devices; an optimisation level of 0 or 1 shortens compilation."""
    flags = [f"--xla_force_host_platform_device_count={devices}"]
    if level is not None:
        flags.append(f"--xla_backend_optimization_level={level}")
        # XLA aborts on a flag that it does not know.
        if jaxlib.version.__version_info__ < (0, 11):
            flags.append("--xla_cpu_use_fusion_emitters=false")
    if level == 0:
        flags.append("--xla_llvm_disable_expensive_passes=true")
    return " ".join(flags)
