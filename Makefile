# Two commands do everything on a machine with Python 3.11, g++ and make: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DEMO_OUT ?= outputs/demo
DEMO_ARGS ?=

.PHONY: demo test test-slow lint docs figures peers mutants setup clean

setup: $(VENV)/.installed

# Re-made when the pins change; re-used otherwise.
$(VENV)/.installed: pyproject.toml constraints.txt infra/setup.sh
	PYTHON=$(PYTHON) VENV=$(VENV) sh infra/setup.sh
	touch $@

demo: setup
	$(BIN)/cat3d demo --out $(DEMO_OUT) $(DEMO_ARGS)

test: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" -q

test-slow: setup
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow -q --timeout 1500

lint: setup
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy
	$(BIN)/bandit --quiet --configfile pyproject.toml --recursive cat3d_core schemas flows infra
	$(BIN)/python -m infra.audit

# Reference pages from the code, then the site; a warning fails. The variable hides a notice about MkDocs 2.
docs: setup
	$(BIN)/python -m infra.docs.reference
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict --config-file infra/docs/mkdocs.yml
	@echo "Site: outputs/site/index.html"

# Every picture of the documents and README's table of quality, in one command: two small sweeps are made first (once,
# half an hour of two idle cores), charts come from tables in docs/.
figures: setup
	$(BIN)/cat3d sweep infra/docs/showcase.yaml --out outputs/showcase
	$(BIN)/cat3d sweep infra/docs/quality.yaml --out outputs/quality
	$(BIN)/python -m infra.docs.figures --showcase outputs/showcase --sweep outputs/quality

# Programs of others, in an environment of their own, for `cat3d bench peers`. Nothing else needs it.
peers:
	PYTHON=$(PYTHON) sh infra/peers.sh

# Small faults in cat3d_core, one at a time: do the quick tests notice? COUNT of each file of ONLY, drawn by SEED; goes on
# where it was interrupted. AGAIN="survived untested" judges those anew, after new tests. TOGETHER: seconds of tests that
# one mutant is given.
ONLY ?= cat3d_core
COUNT ?= 25
SEED ?= 0
AGAIN ?=
TOGETHER ?= 10
MUTANTS_OUT ?= outputs/mutants/$(subst /,_,$(ONLY))_$(COUNT)_$(SEED)
mutants: setup
	[ -x .venv-mutants/bin/python ] || $(PYTHON) -m venv .venv-mutants
	.venv-mutants/bin/python -m pip install -q -r infra/mutants/requirements.txt
	[ -f $(MUTANTS_OUT)/sample.jsonl ] || .venv-mutants/bin/python infra/mutants/generate.py \
	    --only $(ONLY) --count $(COUNT) --seed $(SEED) --out $(MUTANTS_OUT)/sample.jsonl
	OMP_NUM_THREADS=1 $(BIN)/python -m infra.mutants.run --sample $(MUTANTS_OUT)/sample.jsonl \
	    --results $(MUTANTS_OUT)/results.jsonl --again $(AGAIN) --together $(TOGETHER)
	$(BIN)/python -m infra.mutants.report $(MUTANTS_OUT)/results.jsonl --survivors

clean:
	rm -rf $(VENV) outputs build *.egg-info
