"""The arm's kinematics and dynamics as the shared object that libfranka downloads and calls.

Compiled with the machine's C compiler on first use. The emulator itself computes with the same
object, so the client's model and the emulated arm agree to the last bit.

Limits: the mass matrix is constant and diagonal; gravity and Coriolis torques are zero, that is,
compensated without error.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from warp_deform.errors import WarpDeformError

from ..arm.panda import DH_A, DH_ALPHA, DH_D, FLANGE

__all__ = ["INERTIA", "CompilerMissing", "ModelLibrary", "find_compiler", "model_library"]

_INSTALL = "install one with the C library's headers (Debian, Ubuntu: apt install gcc libc6-dev)"
_COMPILING = 60.0  # [s], on a busy machine

# Joint inertias [kg m^2] of the size of the Panda's mass matrix at its ready pose.
INERTIA = (1.0, 1.0, 0.8, 0.8, 0.2, 0.15, 0.06)

_SOURCE = r"""
#include <math.h>
#include <string.h>
static const double A[7] = {%(a)s}, D[7] = {%(d)s};
static const double ALPHA[7] = {%(alpha)s}, INERTIA[7] = {%(inertia)s};

/* o = a b, 4x4 column-major; o may be a or b. */
static void mul(const double *a, const double *b, double *o) {
  double t[16];
  for (int c = 0; c < 4; c++)
    for (int r = 0; r < 4; r++) {
      t[4 * c + r] = 0;
      for (int k = 0; k < 4; k++) t[4 * c + r] += a[4 * k + r] * b[4 * c + k];
    }
  memcpy(o, t, sizeof t);
}

/* Pose of frame n (1-7 joints, 8 flange); the joint frames passed on the way go to `joint`. */
static void chain(const double *q, int n, double joint[][16], double *o) {
  double T[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  for (int i = 0; i < n && i < 7; i++) {
    double ca = cos(ALPHA[i]), sa = sin(ALPHA[i]), ct = cos(q[i]), st = sin(q[i]);
    double M[16] = {ct, st * ca, st * sa, 0, -st, ct * ca, ct * sa, 0,
                    0,  -sa,     ca,      0, A[i], -D[i] * sa, D[i] * ca, 1};
    mul(T, M, T);
    if (joint) memcpy(joint[i], T, sizeof T);
  }
  if (n >= 8) {
    double F[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, %(flange)s, 1};
    mul(T, F, T);
  }
  memcpy(o, T, sizeof T);
}

/* Jacobian (6x7, column-major) of frame n moved on by E, in the base frame or in its own. */
static void jacobian(const double *q, int n, const double *E, int own, double *o) {
  double joint[7][16], T[16], R[16];
  memset(o, 0, 42 * sizeof(double));
  chain(q, n > 8 ? 8 : n, joint, T);
  if (E) mul(T, E, T);
  memcpy(R, T, sizeof R);
  for (int i = 0; i < (n > 7 ? 7 : n); i++) {
    const double *z = &joint[i][8], *p = &joint[i][12];
    double r[3], J[6];
    for (int k = 0; k < 3; k++) r[k] = T[12 + k] - p[k];
    J[0] = z[1] * r[2] - z[2] * r[1];
    J[1] = z[2] * r[0] - z[0] * r[2];
    J[2] = z[0] * r[1] - z[1] * r[0];
    memcpy(J + 3, z, 3 * sizeof(double));
    for (int k = 0; k < 3; k++)
      for (int h = 0; h < 2; h++) {
        double turned = 0;
        for (int m = 0; m < 3; m++) turned += R[4 * k + m] * J[3 * h + m];
        o[6 * i + 3 * h + k] = own ? turned : J[3 * h + k];
      }
  }
}

#define FRAME(n) \
  void O_T_J##n(const double *q, double *o) { chain(q, n, 0, o); } \
  void O_J_J##n(const double *q, double *o) { jacobian(q, n, 0, 0, o); } \
  void Ji_J_J##n(const double *q, double *o) { jacobian(q, n, 0, 1, o); }
FRAME(2) FRAME(3) FRAME(4) FRAME(5) FRAME(6) FRAME(7) FRAME(8)
void O_T_J1(const double *q, double *o) { chain(q, 1, 0, o); }
void O_J_J1(double *o) { memset(o, 0, 42 * sizeof(double)); o[5] = 1; }
void Ji_J_J1(double *o) { memset(o, 0, 42 * sizeof(double)); o[5] = 1; }
void O_T_J9(const double *q, const double *E, double *o) { chain(q, 8, 0, o); mul(o, E, o); }
void O_J_J9(const double *q, const double *E, double *o) { jacobian(q, 9, E, 0, o); }
void Ji_J_J9(const double *q, const double *E, double *o) { jacobian(q, 9, E, 1, o); }
void M_NE(const double *q, const double *I, double m, const double *c, double *o) {
  memset(o, 0, 49 * sizeof(double));
  for (int i = 0; i < 7; i++) o[8 * i] = INERTIA[i];
}
void c_NE(const double *q, const double *dq, const double *I, double m, const double *c,
          double *o) {
  memset(o, 0, 7 * sizeof(double));
}
void g_NE(const double *q, const double *g, double m, const double *c, double *o) {
  memset(o, 0, 7 * sizeof(double));
}
"""


class CompilerMissing(WarpDeformError):
    """No C compiler that works, which the emulator needs for the robot's model library."""


class ModelLibrary:
    """The compiled model: its bytes for the client, and forward kinematics and Jacobian.

    Args:
        binary: a shared object as `model_library` compiles it
        path: where that object stands while it is being loaded
    """

    def __init__(self, binary: bytes, path: Path) -> None:
        self.binary = binary
        library = ctypes.CDLL(str(path))
        self._pose, self._jacobian = library.O_T_J9, library.O_J_J9
        self._pose.restype = self._jacobian.restype = None
        self._pose.argtypes = self._jacobian.argtypes = [ctypes.c_void_p] * 3

    def pose(self, q: np.ndarray, F_T_EE: np.ndarray) -> np.ndarray:
        """Return O_T_EE (16,), column-major, of joint positions [rad] (7,) and F_T_EE (16,)."""
        return self._call(self._pose, q, F_T_EE, 16)

    def jacobian(self, q: np.ndarray, F_T_EE: np.ndarray) -> np.ndarray:
        """Return the Jacobian (6, 7) of the end effector in the base frame [m, rad]."""
        return self._call(self._jacobian, q, F_T_EE, 42).reshape(7, 6).T

    @staticmethod
    def _call(function: Callable[..., None], q: np.ndarray, E: np.ndarray, size: int) -> np.ndarray:
        # Twice a millisecond, and to ask an array where it is takes longer than all the rest: so
        # one holds what is given and what is answered.
        numbers = np.empty(7 + 16 + size)
        numbers[:7], numbers[7:23] = q, E
        first = numbers.ctypes.data
        function(first, first + 7 * numbers.itemsize, first + 23 * numbers.itemsize)
        return numbers[23:]


def find_compiler() -> str | None:
    """Return the path of the C compiler that `model_library` takes; None where there is none."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


@cache
def model_library() -> ModelLibrary:
    """Compile and load the model library; once per process, about 0.2 s.

    Raises:
        CompilerMissing: no C compiler is on the path, or it does not get through
    """
    compiler = find_compiler()
    if compiler is None:
        raise CompilerMissing(
            f"the emulator compiles the robot's model library and found no C compiler; {_INSTALL}"
        )
    numbers = {"a": DH_A, "d": DH_D, "alpha": DH_ALPHA, "inertia": INERTIA}
    listed = {name: ", ".join(f"{x!r}" for x in values) for name, values in numbers.items()}
    with tempfile.TemporaryDirectory() as folder:
        source, path = Path(folder, "model.c"), Path(folder, "model.so")
        source.write_text(_SOURCE % {**listed, "flange": repr(FLANGE)})
        # Fused multiply-add would make the bits depend on the processor.
        options = ("-O2", "-ffp-contract=off", "-shared", "-fPIC")
        command = [compiler, *options, "-o", str(path), str(source), "-lm"]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=_COMPILING)
        except subprocess.CalledProcessError as error:
            complaint = error.stderr.strip().splitlines() or [f"exit code {error.returncode}"]
            raise CompilerMissing(
                f"{compiler} does not compile the robot's model library: {complaint[-1].strip()}; "
                f"{_INSTALL}"
            ) from error
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CompilerMissing(f"{compiler} does not run: {error}; {_INSTALL}") from error
        return ModelLibrary(path.read_bytes(), path)
