// What is asked of the server; what it refuses it says in a line.

async function answered(answer) {
  let told = null;
  try {
    told = await answer.json();
  } catch {
    // It has no JSON to say.
  }
  if (!answer.ok) throw new Error(told?.reason ?? `the server answers ${answer.status}`);
  return told;
}

export async function ask(path) {
  return answered(await fetch(path, { cache: "no-store" }));
}

export async function send(method, path, body = {}) {
  return answered(await fetch(path, {
    method, cache: "no-store", headers: { "content-type": "application/json" },
    body: JSON.stringify(body),
  }));
}

/** A picture; null where there is none. */
export async function askPicture(path) {
  const answer = await fetch(path, { cache: "no-store" });
  if (!answer.ok) await answered(answer);
  return createImageBitmap(await answer.blob());
}
