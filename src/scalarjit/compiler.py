"""LLVM: from the text of its language to code of this processor. Also a program that does so beside another process.

LLVM compiles one function at a time in a process, so what is compiled with care is compiled in another one: of a first
gradient whose functions ran often meanwhile, 6 of 12 s were waiting. That process imports nothing but llvmlite.
"""

import hashlib
import os
import struct
import subprocess
import sys
from functools import cache
from typing import Any

from llvmlite import binding as llvm

from scalarjit import files

# Blocks are long, and to schedule their operations takes most of the time: of 5 MB of text 36 s, and 3 s without.
QUICK = ("-enable-misched=false", "-pre-RA-sched=fast")
# Levels: at once; of heavy loops, with little more; and with care, of what runs often. A first run of a telescopic
# crane takes 23 s where heavy loops have their level, 31 s where they are compiled with care; later ones 2 s each.
AT_ONCE = 0
HEAVY_LOOPS = 1
CARE = 2
LENGTH = struct.Struct("<q")
_is_ready = False


def _target(level: int) -> Any:
    global _is_ready
    if not _is_ready:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        for option in QUICK:
            llvm.set_option("scalarjit", option)
        _is_ready = True
    return llvm.Target.from_default_triple().create_target_machine(
        opt=min(level, 1), jit=True, cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten()
    )


def object_code(text: str, level: int) -> bytes:
    """Compile the text of a module."""
    machine = _target(level)
    module = llvm.parse_assembly(text)
    if level != AT_ONCE:
        builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=1))
        passes = builder.getModulePassManager() if level == CARE else llvm.create_new_module_pass_manager()
        if level == HEAVY_LOOPS:
            passes.add_instruction_combine_pass()
        passes.run(module, builder)
    return machine.emit_object(module)


def digest(*parts: str) -> str:
    """A name for what is compiled of texts, alike in all processes."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:40]


@cache
def _processor():
    features = llvm.get_host_cpu_features().flatten()
    return repr((llvm.llvm_version_info, llvm.get_default_triple(), llvm.get_host_cpu_name(), features))


def file_of(text: str, level: int) -> str:
    """The name of the file in which the object code of a text is kept."""
    return f"{digest(text, _processor())}-{level}.o"


def kept_or_compiled(text: str, level: int) -> bytes:
    """The object code of a text, from disk where it is kept there."""
    code = files.read(file_of(text, level))
    if code is None:
        code = object_code(text, level)
        files.write(file_of(text, level), code)
    return code


def loaded(*code: bytes) -> Any:
    """Load code of modules into this process: the engine tells addresses, and holds them."""
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target(AT_ONCE))
    for each in code:
        engine.add_object_file(llvm.ObjectFileRef.from_data(each))
    engine.finalize_object()
    return engine


class Beside:
    """A process that compiles with care."""

    def __init__(self, level: int) -> None:
        path = f"import sys; sys.path[:] = {sys.path!r}; sys.argv[0] = {__file__!r}; "
        run = f"import runpy; runpy.run_path({__file__!r}, run_name='__main__')"
        command = [sys.executable, "-c", path + run, str(level)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL)

    def object_code(self, text: str) -> bytes:
        """Compile the text of a module.

        **Raises:** `OSError`, `EOFError` where the process has ended.
        """
        to = self._process.stdin
        from_ = self._process.stdout
        assert to is not None
        assert from_ is not None
        data = text.encode()
        to.write(LENGTH.pack(len(data)) + data)
        to.flush()
        return _read(from_)

    def end(self) -> None:
        self._process.kill()


def _read(stream):
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        raise EOFError
    (size,) = LENGTH.unpack(head)
    return stream.read(size)


def _serve(level: int) -> None:
    if hasattr(os, "nice"):
        os.nice(10)  # what users wait for comes first
    to = sys.stdout.buffer
    while True:
        try:
            text = _read(sys.stdin.buffer).decode()
        except EOFError:
            return
        code = object_code(text, level)
        to.write(LENGTH.pack(len(code)) + code)
        to.flush()


if __name__ == "__main__":
    _serve(int(sys.argv[1]))
