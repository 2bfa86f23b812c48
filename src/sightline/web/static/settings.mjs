// What whoever looks has chosen, kept by the browser.

/** The first of some known values, or the one that was kept under a name. */
export function keptSettings(choices) {
  return Object.fromEntries(Object.entries(choices).map(([name, known]) => {
    let kept = null;
    try {
      kept = localStorage.getItem(`sightline.${name}`);
    } catch {
      // Some browsers keep nothing.
    }
    return [name, known.includes(kept) ? kept : known[0]];
  }));
}

/** Go on to the next of the known values of a setting. */
export function nextSetting(settings, choices, name) {
  const known = choices[name];
  settings[name] = known[(known.indexOf(settings[name]) + 1) % known.length];
  try {
    localStorage.setItem(`sightline.${name}`, settings[name]);
  } catch {
    // It holds until the page is closed.
  }
}

/** Show the page in a theme: auto, light or dark. */
export function showTheme(theme) {
  const dark = theme === "dark"
    || (theme === "auto" && matchMedia("(prefers-color-scheme: dark)").matches);
  document.documentElement.dataset.theme = dark ? "dark" : "light";
}

/** Call when the system goes from light to dark, or back. */
export function whenThemeChanges(action) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", action);
}

/** The first letter as a capital. */
export function capital(word) {
  return word[0].toUpperCase() + word.slice(1);
}
