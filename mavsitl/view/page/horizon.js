// The attitude indicator: horizon, pitch ladder, bank scale, what is wanted, and heading. An SVG whose groups are moved.

import { eulerDegrees } from "./frames.js";

const PIXELS_PER_DEGREE = 1.6;
const LADDER = [-60, -45, -30, -20, -10, 10, 20, 30, 45, 60];
const BANKS = [-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60];

const ladder = LADDER.map((degrees) => {
  const y = -degrees * PIXELS_PER_DEGREE;
  const half = degrees % 30 === 0 ? 22 : 13;
  return `<path d="M${-half} ${y}H${half}"/><text x="${half + 4}" y="${y + 3.5}">${Math.abs(degrees)}</text>`;
}).join("");

const banks = BANKS.map((degrees) => `<path d="M0 -92V${degrees % 30 === 0 ? -81 : -86}" transform="rotate(${degrees})"/>`).join("");

const DRAWING = `
<svg viewBox="-102 -102 204 204" role="img" aria-label="Attitude">
  <defs><clipPath id="dial"><circle r="92"/></clipPath></defs>
  <g clip-path="url(#dial)">
    <g data-part="roll"><g data-part="pitch">
      <rect x="-400" y="-700" width="800" height="700" fill="var(--air)"/>
      <rect x="-400" width="800" height="700" fill="var(--earth)"/>
      <path d="M-400 0H400" stroke="#fff" stroke-width="1.6"/>
      <g stroke="#fff" stroke-width="1.4" fill="#fff" font-size="10" style="font-variant-numeric:tabular-nums">
        <g>${ladder.replaceAll("<text", '<text stroke="none"')}</g>
      </g>
    </g></g>
    <g data-part="wanted" fill="none" stroke="#ffd54a" stroke-width="3" stroke-dasharray="6 4"><path d="M-60 0H60"/></g>
  </g>
  <circle r="92" fill="none" stroke="var(--text)" stroke-width="2.5"/>
  <g stroke="#fff" stroke-width="1.6">${banks}</g>
  <g data-part="bank"><path d="M0 -80l-6 11h12z" fill="#fff"/></g>
  <g fill="none" stroke="#111" stroke-width="6.5"><path d="M-64 0h36l9 9M64 0h-36l-9 9M0 0h.01" stroke-linecap="round"/></g>
  <g fill="none" stroke="#fff" stroke-width="3.4"><path d="M-64 0h36l9 9M64 0h-36l-9 9M0 0h.01" stroke-linecap="round"/></g>
  <g><rect x="-27" y="66" width="54" height="22" rx="5" fill="#111c"/>
    <text data-part="heading" y="82" fill="#fff" font-size="15" font-weight="600" text-anchor="middle"></text></g>
</svg>`;

export class Horizon {
  constructor(place) {
    place.innerHTML = DRAWING;
    this.parts = Object.fromEntries([...place.querySelectorAll("[data-part]")].map((part) => [part.dataset.part, part]));
    this.drawing = place.firstElementChild;
  }

  /** `attitude` and `wanted`: FRD -> NED, or null. */
  show(attitude, wanted) {
    this.drawing.style.opacity = attitude ? 1 : 0.35;
    const [roll, pitch, yaw] = eulerDegrees(attitude ?? [1, 0, 0, 0]);
    this.parts.roll.setAttribute("transform", `rotate(${-roll})`);
    this.parts.pitch.setAttribute("transform", `translate(0 ${pitch * PIXELS_PER_DEGREE})`);
    this.parts.bank.setAttribute("transform", `rotate(${-roll})`);
    this.parts.heading.textContent = attitude ? `${String(Math.round(yaw + 360) % 360).padStart(3, "0")}°` : "–";
    this.parts.wanted.style.display = attitude && wanted ? "" : "none";
    if (attitude && wanted) {
      const [rollWanted, pitchWanted] = eulerDegrees(wanted);
      // Where the horizon would be.
      const down = pitchWanted * PIXELS_PER_DEGREE;
      this.parts.wanted.setAttribute("transform", `rotate(${-rollWanted}) translate(0 ${down})`);
    }
  }
}
