"""From a config to statistics on disk: render and learn, choose rank and temper, adapt to a few people's
photographs."""
