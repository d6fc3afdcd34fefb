// Small helpers of pages: elements, and answers of the server.

export const find = (query) => document.querySelector(query);

export const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

export function element(tag, values = {}, ...children) {
  const made = Object.assign(document.createElement(tag), values);
  made.append(...children);
  return made;
}

/** Reads an answer of the server, or throws its words with the status. */
export async function answerOf(address, signal, more = {}) {
  const answer = await fetch(address, { signal, ...more });
  if (!answer.ok) throw Object.assign(new Error(await answer.text()), { status: answer.status });
  return answer;
}

/** Has the server change something: POST with the token of this run of the program. */
export const post = (address, token, values, signal) => answerOf(address, signal,
  { method: "POST", headers: { "X-Token": token }, body: new URLSearchParams(values) });
