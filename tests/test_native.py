"""Building native kernels: what is kept, what is built again, and that nothing breaks where it cannot be done."""

import itertools
import os
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.export
import jax.ffi
import jax.numpy as jnp
import numpy as np
import pytest

from potlp_jax.native import build, libraries

SOURCE = """
#include "rows.h"

namespace ffi = xla::ffi;

namespace {
ffi::Error scale_rows(ffi::ThreadPool pool, ffi::Buffer<ffi::F32> in, ffi::ResultBuffer<ffi::F32> out) {
  for_each_row(pool, in.element_count(), [&](int64_t i) { out->typed_data()[i] = FACTOR * in.typed_data()[i]; });
  return ffi::Error::Success();
}
}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(KERNEL_NAME, scale_rows, ffi::Ffi::Bind().Ctx<ffi::ThreadPool>()
                                                     .Arg<ffi::Buffer<ffi::F32>>().Ret<ffi::Buffer<ffi::F32>>());
"""

_numbers = itertools.count()


@pytest.fixture
def kernels(tmp_path, monkeypatch) -> Path:
    """A folder of sources with one library, and an empty cache."""
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / "rows.h").write_text((build.KERNELS / "rows.h").read_text())
    # XLA registers a handler's name once in a process.
    handler = f"scale_{next(_numbers)}"
    (folder / "scale.cc").write_text(SOURCE.replace("FACTOR", "2").replace("KERNEL_NAME", handler))
    monkeypatch.setattr(build, "KERNELS", folder)
    monkeypatch.setitem(libraries.LIBRARIES, "scale", (handler,))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("POTLP_NO_CACHE", raising=False)
    libraries._loaded.cache_clear()
    yield folder
    libraries._loaded.cache_clear()


@pytest.fixture
def compiler() -> None:
    try:
        build.find_compiler()
    except build.BuildError as error:
        pytest.skip(str(error))


def _scale(values: jax.Array) -> jax.Array:
    """Doubled by the kernel, tripled by what is no twin, to tell them apart."""

    def native(values):
        name = libraries.target(libraries.LIBRARIES["scale"][0])
        call = jax.ffi.ffi_call(name, jax.ShapeDtypeStruct(values.shape, values.dtype))
        return call(values)

    return libraries.by_platform("scale", native, lambda values: values * 3, values)


def test_a_kernel_runs_on_all_rows_and_is_compiled_once(kernels, compiler):
    values = jnp.arange(100, dtype=jnp.float32)
    np.testing.assert_array_equal(jax.jit(_scale)(values), 2 * values)
    file = build.built_library("scale")
    before = file.stat().st_mtime_ns
    assert build.built_library("scale") == file
    assert file.stat().st_mtime_ns == before
    assert [path.name for path in file.parent.iterdir()] == [file.name]
    assert libraries._loaded("scale").reason == ""


def test_a_program_traced_with_kernels_is_not_taken_for_one_without(kernels, compiler):
    double, values = jax.jit(_scale), jnp.ones(3, jnp.float32)
    np.testing.assert_array_equal(double(values), [2, 2, 2])
    with libraries.twin_only():
        np.testing.assert_array_equal(double(values), [3, 3, 3])
        assert "custom_call" not in jax.export.export(double)(values).mlir_module()
    np.testing.assert_array_equal(double(values), [2, 2, 2])


@pytest.mark.long
def test_a_changed_source_or_header_is_compiled_again(kernels, compiler):
    first = build.built_library("scale")
    source = kernels / "scale.cc"
    source.write_text(source.read_text().replace("2 * in", "4 * in"))
    second = build.built_library("scale")
    (kernels / "rows.h").write_text((kernels / "rows.h").read_text() + "\n// Changed.\n")
    third = build.built_library("scale")
    assert len({first, second, third}) == 3


@pytest.mark.long
def test_a_broken_file_of_the_cache_is_not_loaded(kernels, compiler):
    file = build.built_library("scale")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert build.built_library("scale").read_bytes()[: len(whole) // 2] == whole[: len(whole) // 2]
    np.testing.assert_array_equal(_scale(jnp.ones(2, jnp.float32)), [2, 2])


@pytest.mark.long
def test_processes_that_race_all_get_a_whole_library(kernels, compiler):
    with ThreadPoolExecutor(3) as pool:
        files = list(pool.map(lambda _: build.built_library("scale"), range(3)))
    for file in files:
        assert file.stem.endswith(build._digest(file.read_bytes()))
    assert not list(files[0].parent.glob("*.part"))


def test_without_a_compiler_the_twin_runs_and_the_status_says_why(kernels, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    # No warning: nothing here needs a compiler.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(_scale(jnp.ones(2, jnp.float32)), [3, 3])
    assert "no C++ compiler" in libraries._loaded("scale").reason


@pytest.mark.parametrize("named", ["wrapper {compiler}", "'{folder}/my tools/c++'", "{folder}/my tools/c++"])
def test_the_compiler_that_is_named_may_have_words_behind_it(named, compiler, tmp_path, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    (path,) = build.find_compiler().command
    (tmp_path / "my tools").mkdir()
    for program, text in (("wrapper", 'exec "$@"'), ("my tools/c++", f'exec {path} "$@"')):
        (tmp_path / program).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / program).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("CXX", named.format(compiler=path, folder=tmp_path))
    found = build.find_compiler()
    assert found.command[0].startswith(str(tmp_path))
    assert found.command[1:] == ((path,) if named.startswith("wrapper") else ())


@pytest.mark.parametrize("named", ["nowhere++", "nowhere -m32", "'c++"])
def test_a_compiler_that_is_named_and_not_there_is_said(named, kernels, monkeypatch):
    monkeypatch.setenv("CXX", named)
    with pytest.warns(UserWarning, match=r"scale: the native kernel cannot be used here.*CXX is"):
        np.testing.assert_array_equal(_scale(jnp.ones(2, jnp.float32)), [3, 3])


def test_with_a_wrapped_compiler_kernels_are_built(kernels, compiler, tmp_path, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    (path,) = build.find_compiler().command
    (tmp_path / "wrapper").write_text('#!/bin/sh\nexec "$@"\n')
    (tmp_path / "wrapper").chmod(0o755)
    monkeypatch.setenv("CXX", f"{tmp_path / 'wrapper'} {path}")
    np.testing.assert_array_equal(_scale(jnp.ones(2, jnp.float32)), [2, 2])


def test_what_does_not_compile_leaves_the_twin_and_no_file_and_is_said(kernels, compiler):
    (kernels / "scale.cc").write_text("not C++")
    with pytest.warns(UserWarning, match=r"scale: the native kernel cannot be used here.*slower"):
        np.testing.assert_array_equal(_scale(jnp.ones(2, jnp.float32)), [3, 3])
    assert "failed" in libraries._loaded("scale").reason
    assert not list((kernels.parent / "cache").rglob("*.part"))


def test_the_switch_turns_kernels_off(kernels, monkeypatch):
    monkeypatch.setenv("POTLP_NATIVE", "0")
    np.testing.assert_array_equal(_scale(jnp.ones(2, jnp.float32)), [3, 3])
    assert libraries._loaded("scale").reason == "POTLP_NATIVE is 0"


def test_a_folder_that_others_may_write_to_is_not_used(kernels, compiler):
    folder = build.cache_folder() / "native"
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    assert folder not in build.built_library("scale").parents
    assert not list(folder.iterdir())


@pytest.mark.parametrize("path", ["", os.environ["PATH"]])
def test_the_command_says_what_is_used(path):
    environment = {**os.environ, "PATH": path, "CXX": ""}
    command = [sys.executable, "-m", "potlp_jax.native"]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    lines = result.stdout.splitlines()
    assert [line.partition(":")[0] for line in lines] == list(libraries.LIBRARIES)
    assert result.returncode == int(any("JAX twin, because" in line for line in lines))


def test_a_user_without_a_home_has_no_cache_and_native_kernels(monkeypatch):
    """As in a container that runs under a number."""

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert build.cache_folder() is None
    assert build.built_library("paths").is_file()
