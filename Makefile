# ddprt: the two commands of the README are `make cornell` and `make test`.
PYTHON ?= python3.11
BIN := .venv/bin
WORKERS ?= 2
READY := .venv/.ready
VIEWER := ddprt/export/viewer

.PHONY: cornell test test-slow check format lock viewer clean

cornell: $(READY)
	$(BIN)/ddprt run configs/cornell.toml --out runs/cornell

test: $(READY)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

test-slow: $(READY)
	$(BIN)/python -m pytest -m slow

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Installed from hashed wheels, then the project itself without touching the network again.
$(READY): requirements.lock pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "make: got no $(PYTHON), expected Python 3.11; set PYTHON=/path/to/python3.11"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

# Needs uv; writes no addresses into the lock.
lock:
	uv pip compile pyproject.toml --extra test --extra reference --extra denoise --extra flip --extra textures --extra dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-emit-find-links --no-annotate --no-header --output-file requirements.lock

# Needs Node 20 or later and npm; users need neither, for the bundle is committed. Built apart, so that no package is shipped.
viewer:
	rm -rf .cache/viewer && mkdir -p .cache/viewer
	cp -r $(VIEWER)/src $(VIEWER)/package.json $(VIEWER)/build.mjs .cache/viewer
	cd .cache/viewer && npm install --no-audit --no-fund && npm run build
	cp .cache/viewer/viewer.js $(VIEWER)/viewer.js

clean:
	rm -rf .venv runs .pytest_cache .mypy_cache .ruff_cache .hypothesis
