#!/usr/bin/env bash
# From a clean clone to a relit photograph: set up, relight the astronaut under eight lights.
source "$(dirname "$0")/setup_env.sh" demo
mkdir -p outputs
.venv/bin/python -c '
from PIL import Image
from skimage.data import astronaut  # NASA, public domain
Image.fromarray(astronaut()).save("outputs/astronaut.png")'
.venv/bin/facerelight relight outputs/astronaut.png --output outputs/astronaut_relit.png --force \
  --azimuth 0 60 30 -30 -60 0 45 -45 --elevation 0 0 0 0 0 45 30 30
.venv/bin/facerelight viewer outputs/astronaut.png --output outputs/astronaut.html --force
.venv/bin/python scripts/figures/readme_images.py --photo outputs/astronaut.png --output outputs
echo "pictures: $(pwd)/outputs (astronaut_relit_*.png, and all of them on one sheet: relit.png; to light by hand: astronaut.html)"
