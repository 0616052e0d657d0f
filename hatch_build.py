"""Compile the kernel in C with the package: in place for an editable installation, into the wheel for any other."""

from __future__ import annotations

import importlib.util
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class KernelHook(BuildHookInterface):  # type: ignore[type-arg]
    """A wheel without the kernel where it cannot be compiled: the torch path computes then."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        path = Path(self.root, "dyntorch", "native", "build.py")
        spec = importlib.util.spec_from_file_location("kernel_build", path)
        assert spec is not None and spec.loader is not None
        build = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(build)
        in_place = version == "editable"
        target = build.LIBRARY if in_place else Path(tempfile.mkdtemp(), build.LIBRARY.name)
        reason = build.compile_library(target)
        if reason:
            self.app.display_warning(f"the kernel was not compiled, torch computes: {reason}")
        elif not in_place:
            build_data["force_include"][str(target)] = f"dyntorch/native/{target.name}"
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
        self.app.display_info("kernel: not compiled" if reason else "kernel: compiled")
