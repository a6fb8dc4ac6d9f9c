"""Kernels in C++ for CPUs, each beside a twin in JAX that gives the same answers everywhere.

A **library** is one file ``kernels/NAME.cc``. It is compiled by the system's C++ compiler the first time a program that
wants it is traced, kept in the user's cache, and called through ``jax.ffi``. Where that is not possible (no compiler, a
failed compilation, ``POTLP_NATIVE=0``), or on another platform than CPU, the twin runs, silently; ``status()`` and
``python -m potlp_jax.native`` tell.

To add a kernel:

1. Write ``kernels/NAME.cc``: C++17, ``#include "xla/ffi/api/ffi.h"``, everything but the handlers in an anonymous
   namespace, one ``XLA_FFI_DEFINE_HANDLER_SYMBOL(handler, ...)`` per kernel. Headers that libraries share lie beside it
   (``rows.h`` spreads rows over XLA's threads).
2. Add it to ``libraries.LIBRARIES``, with the names of its handlers. The targets of ``jax.ffi.ffi_call`` are then
   ``target("handler")``.
3. Call it by platform, where all array arguments are given one by one or as pytrees::

       by_platform("NAME", native_function, twin_function, *arguments)

   Both take the arguments and return arrays of the same shapes and types. Within ``jax.shard_map`` the results of
   ``ffi_call`` carry no marks: pass them through ``planning.sharding.vary_alike(results, arguments)``. For ``jax.vmap``
   write a ``custom_vmap`` that merges the axes, or give ``ffi_call`` a ``vmap_method``.
4. Test that both give the same bits: ``with twin_only(): ...`` traces the twin.

Within ``twin_only()`` no native kernel enters a program: what is exported needs JAX alone.
"""

from potlp_jax.native.libraries import LibraryStatus as LibraryStatus
from potlp_jax.native.libraries import by_platform as by_platform
from potlp_jax.native.libraries import is_usable as is_usable
from potlp_jax.native.libraries import status as status
from potlp_jax.native.libraries import target as target
from potlp_jax.native.libraries import twin_only as twin_only
from potlp_jax.native.libraries import without_derivative as without_derivative
