# What the entry scripts share. Sourced, never run.
# shellcheck shell=bash

ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

say() { printf '[mr360] %s\n' "$*" >&2; }

# fail CODE MESSAGE…: codes as those of the programs, 1 failed while running, 2 wrong usage or input.
fail() {
    local code=$1
    shift
    printf '[mr360] error: %s\n' "$*" >&2
    exit "$code"
}

have() { command -v "$1" >/dev/null 2>&1; }

# Puts cargo on the PATH where rustup installed it for this user but the shell does not know yet.
find_cargo() {
    have cargo && return
    local bin=${CARGO_HOME:-$HOME/.cargo}/bin
    if [[ -x $bin/cargo ]]; then
        PATH=$bin:$PATH
        return
    fi
    fail 1 "cargo is missing. Install Rust with rustup (https://rustup.rs), then run this again."
}

# Where cargo puts what it builds; tools and media are kept beside it, so that `cargo clean` removes everything.
target_dir() {
    local metadata dir
    metadata=$(cd "$ROOT" && cargo metadata --format-version 1 --no-deps) || fail 1 "cargo metadata failed, see above"
    dir=${metadata##*\"target_directory\":\"}
    dir=${dir%%\"*}
    [[ $dir == /* ]] || fail 1 "cargo metadata names no target directory"
    printf '%s\n' "$dir"
}
