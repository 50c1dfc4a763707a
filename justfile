# Commands for contributors, after `pip install -e ".[dev]"`. Run `just` for a list.

default:
    @just --list

# Run the default tests
test *arguments:
    pytest {{arguments}}

# Run all slow tests
test-slow *arguments:
    pytest -m slow {{arguments}}

# Check style, layers and types
lint:
    ruff check .
    ruff format --check .
    lint-imports
    pyright

# Build the documentation into `site`
docs:
    python -W error .ci/docs site

# Run everything in fresh environments, as CI does
ci:
    .ci/run
