#!/usr/bin/with-contenv bashio
SIGHTFIX_ADMIN_KEY="$(bashio::config 'admin_key')"
SIGHTFIX_ALLOWED_HOSTS="$(bashio::config 'allowed_hosts')"
export SIGHTFIX_ADMIN_KEY SIGHTFIX_ALLOWED_HOSTS
if [ -z "$SIGHTFIX_ADMIN_KEY" ]; then
  bashio::exit.nok "Set the option admin_key; a new one is: $(sightfix keys generate)"
fi
exec sightfix serve --data /data/sightfix --listen 0.0.0.0:8080
