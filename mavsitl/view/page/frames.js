// From the wire's frames, NED and FRD, to the picture's (x right/east, y up, z towards us/south), and to numbers for people.

/** A vector NED -> [x, y, z] of the picture; FRD goes to the model's axes the same way. */
export const toScene = ([north, east, down]) => [east, -down, -north];

/** An attitude FRD -> NED, scalar first -> [x, y, z, w] that turns the model in the picture. */
export const toSceneQuaternion = ([w, x, y, z]) => [y, -z, -x, w];

const DEGREES = 180 / Math.PI;

/** Roll, pitch and yaw in degrees, Z-Y-X. */
export function eulerDegrees([w, x, y, z]) {
  const roll = Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y));
  const pitch = Math.asin(Math.max(-1, Math.min(1, 2 * (w * y - z * x))));
  const yaw = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
  return [roll * DEGREES, pitch * DEGREES, yaw * DEGREES];
}

/** The short way round, degrees in [-180, 180). */
export const shortWay = (degrees) => ((((degrees + 180) % 360) + 360) % 360) - 180;

export const length = (vector) => Math.hypot(...vector);

/** A number with its sign, so that columns of numbers stand still. */
export function signed(value, digits) {
  if (value === null || value === undefined) return "–";
  const text = Math.abs(value).toFixed(digits);
  return (value < 0 && Number(text) !== 0 ? "−" : "") + text;
}

/** Seconds as minutes and seconds. */
export function clock(seconds, digits = 0) {
  const minutes = Math.floor(seconds / 60);
  const rest = (seconds - 60 * minutes).toFixed(digits).padStart(digits ? 3 + digits : 2, "0");
  return `${minutes}:${rest}`;
}
