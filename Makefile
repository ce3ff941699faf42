# The two commands of the README, and what they rest on.
.PHONY: setup run test lint types fast format fuzz

PYTHON ?= python3
BIN := .venv/bin

setup:
	@PYTHON=$(PYTHON) ./deploy/setup

run: setup
	@$(BIN)/treedock run --source sim $(ARGS)

test: setup
	@./deploy/check $(ARGS)

lint:
	@$(BIN)/ruff format --check . && $(BIN)/ruff check .

types:
	@$(BIN)/mypy

format:
	@$(BIN)/ruff format . && $(BIN)/ruff check --fix .

fast: lint types
	@$(BIN)/pytest tests/unit tests/contract tests/architecture

# Every reader of foreign bytes, for as many cases as wanted: make fuzz CASES=20000
fuzz: CASES ?= 5000
fuzz:
	@TREEDOCK_FUZZ=$(CASES) $(BIN)/pytest -q tests/fuzz
