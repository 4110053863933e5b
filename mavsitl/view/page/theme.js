// Light or dark: the system's choice, or the user's by a switch. Canvases need the colours that the style sheet has by name.

const CHOICES = ["auto", "light", "dark"];
const KEY = "mavsitl-theme";

const probe = document.createElement("span");
probe.hidden = true;
document.documentElement.append(probe);

/** The present value of a custom property that is a colour, such as "--blue". */
export function colour(name) {
  probe.style.color = `var(${name})`;
  return getComputedStyle(probe).color;
}

/** Colours of vehicles, one after the other. */
const OWN = ["--blue", "--orange", "--green", "--purple", "--amber", "--ink"];
export const ownColourName = (number) => OWN[(number - 1) % OWN.length];

/** Make the switch; `onChange` is called whenever the colours are others. */
export function startTheme(button, onChange) {
  let choice = CHOICES.includes(saved()) ? saved() : "auto";
  const apply = () => {
    if (choice === "auto") delete document.documentElement.dataset.theme;
    else document.documentElement.dataset.theme = choice;
    button.textContent = { auto: "◐ auto", light: "☀ light", dark: "☾ dark" }[choice];
    button.title = "Colours: as the system has them, light, or dark";
    onChange();
  };
  button.addEventListener("click", () => {
    choice = CHOICES[(CHOICES.indexOf(choice) + 1) % CHOICES.length];
    save(choice);
    apply();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", apply);
  apply();
}

// A browser may forbid a page to keep anything.
function saved() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  }
}

function save(choice) {
  try {
    localStorage.setItem(KEY, choice);
  } catch {
    // It holds until the page is closed.
  }
}
