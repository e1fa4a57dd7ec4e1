# `make help` lists the targets. ARGS is passed on:  make test ARGS='-k matrix -x'
# PYTHON names the interpreter for .venv; without it, set-up takes the first suitable one it finds.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help build smax demo test chaos bench bench-peers reproduce lint lock clean
export PYTHON
# Those of the named options that have a value, as the program takes them.
given = $(foreach option,$(1),$(if $($(option)),--$(option) $($(option))))

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-11s %s\n", $$1, $$2 }' Makefile

build:  ## set up .venv and build both packages; does nothing when that is done
	@scripts/setup.sh

smax: build  ## add JaxMARL to .venv, for the battles of SMAX; needs CPython 3.11 or newer
	@.venv/bin/uv pip install --python .venv/bin/python --no-deps -r requirements/smax.txt

demo: build  ## train cooperative navigation over a ROS graph on this machine; ARGS goes to bringup
	@. scripts/env.sh && exec install/dae_ros/lib/dae_ros/bringup config/demo.yaml $(ARGS)

test: build  ## run every test; ARGS goes to pytest
	@. scripts/env.sh && exec python -m pytest $(ARGS)

chaos: build  ## kill nodes at random during a training, 40 times, and compare the weights; kills=100 seed=2
	@. scripts/env.sh && CHAOS_KILLS=$(or $(kills),40) CHAOS_SEED=$(or $(seed),1) exec python -m pytest -s -k whoever tests/graph/test_chaos.py $(ARGS)

bench: build  ## measure speeds and phases on this machine; ARGS names parts, such as scale
	@. scripts/env.sh && exec python -m benchmarks $(ARGS)

bench-peers: build  ## compare with BenchMARL, VMAS, JaxMARL and mpe2; ARGS='--jaxmarl /path/to/checkout --rounds 5'
	@. scripts/env.sh && exec python -m benchmarks.peers $(ARGS)

reproduce: build  ## train and draw the paper's figures; figure='1b 4' seeds=5 steps=200000 workers=2, ARGS=--list
	@. scripts/env.sh && exec python -m reproduce $(figure) $(call given,seeds steps workers) $(ARGS)

lint: build  ## check the style with ruff
	@.venv/bin/ruff check $(ARGS)

lock: build  ## choose the versions in requirements/*.txt anew
	@scripts/lock.sh

clean:  ## remove what set-up and tests made; runs/ stays
	@rm -rf .venv .peers build install log .pytest_cache .hypothesis .ruff_cache
	@find . -name __pycache__ -prune -exec rm -rf {} +
