#!/usr/bin/env bash
# Set up a virtual environment, then run the linters and every test.
source "$(dirname "$0")/setup_env.sh" test
.venv/bin/ruff check . && .venv/bin/ruff format --check -q . && .venv/bin/mypy
export OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-PASSIVE} # beside other work, threads that spin while they wait take minutes
exec .venv/bin/python -m pytest "$@"
