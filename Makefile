# Works on a machine with Python 3.11 and nothing else installed. `make PYTHON=python3.12 venv` picks
# another interpreter.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
SUDO ?= $(if $(filter 0,$(shell id -u)),,sudo -n)
STAMP := $(VENV)/.installed
DEMO := demo

# Where Python may not keep what it has compiled, each of the processes that the tests start compiles
# torch and Newton again, for longer than most tests take.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help venv demo test test-lerobot check lint format bench docs chromium three clean

help:
	@echo "make demo    demonstrations of cable-shape and bag-items-1 and their videos, under demo/"
	@echo "make test    the tests, on every core"
	@echo "make test-lerobot   train and play a policy of LeRobot on our demonstrations (gigabytes)"
	@echo "make check   lint, and the quick half of the tests: while you edit"
	@echo "make lint    ruff and mypy"
	@echo "make format  let ruff rewrite what it can"
	@echo "make bench   time the simulator"
	@echo "make docs    the documentation site, in build/site; a broken link fails"
	@echo "make chromium   Debian's Chromium, in which tests open the page"
	@echo "make three   bundle three.js anew, and compare it with the one that is checked in (needs node)"
	@echo "make clean   remove demo/ and caches (the environment stays: remove $(VENV) by hand)"

venv: $(STAMP)

# Installs again only when what is to be installed has changed. Python compiles modules when they are
# first imported: pip would compile all of them, most of which nobody imports, in as long as the rest.
$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[dev]'
	touch $@

demo: $(STAMP)
	$(BIN)/warp-deform demo cable-shape -n 5 --out $(DEMO)/cable-shape --video $(DEMO)/cable-shape.mp4
	$(BIN)/warp-deform demo bag-items-1 -n 2 --demonstrator visible \
		--out $(DEMO)/bag-items-1 --video $(DEMO)/bag-items-1.mp4
	@echo "episodes and videos: $(DEMO)/"

# Neighbours share kernels and fixtures: a worker begins with a run of them, and steals later.
test: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist worksteal --durations 20 tests

# LeRobot wants an older torch than ours, of which Linux has builds for CUDA alone: an environment of
# its own, of 9 GB. Everything after it is made runs offline, on the CPU.
LEROBOT ?= build/lerobot
LEROBOT_RUN := build/lerobot-run
test-lerobot: $(STAMP)
	test -x $(LEROBOT)/bin/lerobot-eval || { $(PYTHON) -m venv $(LEROBOT) && $(LEROBOT)/bin/python -m pip \
		install --quiet --no-compile lerobot==0.4.4 -e . -e benchmarks/lerobot_env; }
	rm -rf $(LEROBOT_RUN)
	$(BIN)/warp-deform demo block-notarget --control -n 4 --verify --out $(LEROBOT_RUN)/demos
	$(BIN)/warp-deform convert $(LEROBOT_RUN)/demos $(LEROBOT_RUN)/data --to lerobot
	HF_HUB_OFFLINE=1 $(LEROBOT)/bin/lerobot-train --dataset.repo_id=local/block-notarget \
		--dataset.root=$(LEROBOT_RUN)/data --policy.type=act --policy.device=cpu \
		--policy.push_to_hub=false --policy.pretrained_backbone_weights=null --policy.dim_model=128 \
		--policy.dim_feedforward=256 --policy.chunk_size=20 --policy.n_action_steps=20 --steps=50 \
		--batch_size=8 --num_workers=0 --log_freq=10 --output_dir=$(LEROBOT_RUN)/act
	HF_HUB_OFFLINE=1 $(LEROBOT)/bin/lerobot-eval --policy.path=$(LEROBOT_RUN)/act/checkpoints/last/pretrained_model \
		--policy.device=cpu --env.type=warp_deform --env.discover_packages_path=lerobot_env_warp_deform \
		--env.task=block-notarget --env.obs_type=environment_state_agent_pos --env.episode_length=60 \
		--eval.n_episodes=1 --eval.batch_size=1 --output_dir=$(LEROBOT_RUN)/evaluation

# What tests/slow.txt lists is left out.
check: lint
	$(BIN)/python -m pytest -n auto --dist worksteal --quick -q tests

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)
	$(BIN)/warp-deform bench

# Not --quiet: that hides warnings from --strict, too.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open build/site/index.html; to search it, serve it: python3 -m http.server -d build/site"

# Tests of the page without it are skipped and say so.
chromium:
	command -v chromium || { $(SUDO) apt-get update -qq && \
		$(SUDO) apt-get install -y -qq --no-install-recommends chromium; }

# What the page draws with: its entry file and its licence stand beside it.
THREE := warp_deform/page/static
three:
	mkdir -p build/three && cp $(THREE)/three_entry.js build/three
	cd build/three && npm install --no-audit --no-fund --no-save three@0.187.0 esbuild@0.28.2 && \
		npx esbuild three_entry.js --bundle --minify --format=esm --outfile=three.js
	cmp build/three/three.js $(THREE)/three.js
	cmp build/three/node_modules/three/LICENSE $(THREE)/three.LICENSE

clean:
	rm -rf demo build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find warp_deform learning hardware tests -name __pycache__ -type d -prune -exec rm -rf {} +
