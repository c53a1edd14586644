#!/usr/bin/env bash
# Set up a virtual environment, then run the linters and every test.
source "$(dirname "$0")/setup_env.sh" test
.venv/bin/ruff check . && .venv/bin/ruff format --check -q . && .venv/bin/mypy
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} # of small tensors; a second thread costs more than it brings
exec .venv/bin/python -m pytest "$@"
