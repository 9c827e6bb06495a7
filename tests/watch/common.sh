# What the scripts beside this one share. Source it, then change to the project's folder.
skip() { echo "skipped: $1"; exit 77; }
command -v openssl >/dev/null || skip "no openssl"
relay=${PLIANT_MOQ_RELAY:-$(command -v moq-relay)}
[ -x "$relay" ] || skip "no moq-relay (cargo install moq-relay --version 0.17.10)"

# Builds these examples, and sets BIN to where they are, unless it is set. Needs the project's
# folder.
build() {
    [ -z "${BIN:-}" ] || return 0
    for example; do
        cargo build --release -p pliant_examples --no-default-features --features watch \
            --example "$example" || exit 2
    done
    BIN=$(cargo metadata --format-version 1 --no-deps |
        sed 's/.*"target_directory":"\([^"]*\)".*/\1/')/release
}
