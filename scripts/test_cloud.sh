#!/usr/bin/env bash
# Matrices in object stores: installs a local S3 server (moto, from PyPI) in target/python/s3 and runs the tests against it;
# `test_cloud.sh install` does no more than that.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/python_env.sh

environment s3 "moto[server]>=5,<6"
[ "${1:-}" = install ] && exit
ACQUIRE_S3_SERVER=$work/s3/bin/moto_server cargo test --release --locked --features cloud --test cloud
