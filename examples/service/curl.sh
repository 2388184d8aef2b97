#!/usr/bin/env bash
# One questionnaire with curl alone:  bash examples/service/curl.sh http://127.0.0.1:8000
set -euo pipefail
service=$1
post() { curl --silent --show-error --fail --retry 5 --json "$2" "$service/$1"; }
value() { grep -o "\"$1\":\(\"[^\"]*\"\|[^,}]*\)" | head -1 | cut -d: -f2 | tr -d '"'; }

reply=$(post questionnaires '{"person": "curl"}')
id=$(value id <<<"$reply")
while [ "$(value kind <<<"$reply")" = ask ]; do
    echo "question $(value number <<<"$reply"): the robot $(value text <<<"$reply")" >&2
    reply=$(post "questionnaires/$id/answers" "{\"number\": $(value number <<<"$reply"), \"answer\": 1}")
done
curl --silent --fail "$service/questionnaires/$id/labels.csv"
