"""The kernels in the CUDA sources, and the architectures that tests compile them for."""

import re

from sigmasplat.plugins.cuda import cubins

ARCHITECTURES = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")


def kernel_names(features: int) -> list[str]:
    """List the kernels that a program defines, whatever its feature count."""
    texts = ((cubins.FOLDER / name).read_text(encoding="utf-8") for name in cubins.TEXTS[cubins.text_of(features)])
    return [name for text in texts for name in re.findall(r"^KERNEL (\w+)\(", text, re.MULTILINE)]
