#!/usr/bin/env bash
# Prints the size of each crate, as a Markdown table: lines of `src`, its longest file, its public
# items, and which names of public types are in several crates.
#
# Public items are lines that begin with `pub` and an item's keyword, after blanks. This counts
# methods too, and items in private modules, so that it compares two states and is no exact number.
#
# Usage: benches/sizes.sh [COMMIT]    without a commit: the files as they are
set -euo pipefail
cd "$(dirname "$0")/.."

if [ "$#" -gt 0 ]; then
    scratch="$(mktemp -d)"
    trap 'rm -rf "$scratch"' EXIT
    git archive "$1" crates | tar -x -C "$scratch"
    cd "$scratch"
fi

item='^ *pub (async |unsafe |const )*(fn|struct|enum|trait|type|const|static|union|macro) '
type='^ *pub (struct|enum|trait|type|union) '
names="$(mktemp)"
total=0 items_of_all=0
echo "| crate | lines of src | longest file | lines | public items |"
echo "| --- | ---: | --- | ---: | ---: |"
for crate in crates/*/; do
    [ -d "$crate/src" ] || continue
    name="$(basename "$crate")"
    lines="$(find "$crate/src" -name '*.rs' -exec cat {} + | wc -l)"
    longest="$(find "$crate/src" -name '*.rs' -exec wc -l {} + |
        awk '$2 != "total" && $1 > most { most = $1; line = $0 } END { print line }')"
    items="$(find "$crate/src" -name '*.rs' -exec cat {} + | grep -cE "$item" || true)"
    find "$crate/src" -name '*.rs' -exec cat {} + | sed -nE "s/$type([A-Za-z0-9_]+).*/\2/p" |
        sort -u | sed "s/\$/ $name/" >>"$names"
    read -r count path <<<"$longest"
    echo "| $name | $lines | ${path#"$crate"/} | $count | $items |"
    total=$((total + lines)) items_of_all=$((items_of_all + items))
done
echo "| all | $total | | | $items_of_all |"
echo
echo "Names of public types in several crates:"
sort "$names" | awk '{ crates[$1] = crates[$1] " " $2; count[$1]++ }
    END { for (name in count) if (count[name] > 1) print "- " name ":" crates[name] }' | sort
rm -f "$names"
