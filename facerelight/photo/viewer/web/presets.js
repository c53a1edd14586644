// Set-ups that photographers know by name.

const lamp = (azimuth, elevation, size = 5, power = 1, colour = "#ffffff") => ({ azimuth, elevation, size, power, colour });

const PRESETS = {
  Loop: { lamps: [lamp(40, 30, 8)], fill: 0.15 },
  Butterfly: { lamps: [lamp(0, 45, 8)], fill: 0.12 },
  Rembrandt: { lamps: [lamp(55, 40, 5)], fill: 0.08 },
  Split: { lamps: [lamp(88, 5, 5)], fill: 0.06 },
  Window: { lamps: [lamp(65, 15, 35)], fill: 0.12 },
  Clamshell: { lamps: [lamp(0, 40, 15), lamp(0, -40, 30, 0.4)], fill: 0.1 },
  "Two colours": { lamps: [lamp(65, 10, 10, 1, "#ff9d5c"), lamp(-65, 10, 10, 0.9, "#5c9dff")], fill: 0.08 },
  Rim: { lamps: [lamp(-125, 25, 10, 1.6), lamp(35, 25, 12, 0.7)], fill: 0.1 },
  Overcast: { lamps: [lamp(0, 60, 60)], fill: 0.4 },
};
