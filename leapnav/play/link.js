// Links that contain the scenario: its JSON text in the fragment of the address, as base64url, compressed if possible.

import { byId, closeLesson, play, request, setScenario, show } from "./state.js";

const MAX_LINK_SIZE = 1e6; // characters of the JSON text
const DAMAGED_LINK = "link: it is damaged or contains no scenario";
const LINK_PATTERN = /^#([zj])\.([\w-]+)$/; // "z": deflate-raw, "j": not compressed

export function encodeBase64(bytes) {
  let text = "";
  for (const byte of bytes) text += String.fromCharCode(byte);
  return btoa(text).replace(/\+/g, "-").replace(/\//g, "_").replace(/=+$/, "");
}

function decodeBase64(text) {
  return Uint8Array.from(atob(text.replace(/-/g, "+").replace(/_/g, "/")), (character) => character.charCodeAt(0));
}

// Passes bytes through a stream; rejects more than MAX_LINK_SIZE bytes.
async function passThrough(bytes, stream) {
  const reader = new Blob([bytes]).stream().pipeThrough(stream).getReader(), parts = [];
  for (let size = 0; ; ) {
    const { done, value } = await reader.read();
    if (done) break;
    size += value.length;
    if (size > MAX_LINK_SIZE) throw new Error(DAMAGED_LINK);
    parts.push(value);
  }
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

export async function scenarioLink(scenario) {
  const bytes = new TextEncoder().encode(JSON.stringify(scenario));
  const isCompressed = "CompressionStream" in window;
  const content = isCompressed ? await passThrough(bytes, new CompressionStream("deflate-raw")) : bytes;
  return `${location.origin}${location.pathname}#${isCompressed ? "z" : "j"}.${encodeBase64(content)}`;
}

// The scenario in the fragment of an address, validated by the server; null if the fragment is empty.
async function scenarioOfLink(hash) {
  if (hash.length <= 1) return null;
  const match = LINK_PATTERN.exec(hash);
  if (!match || hash.length > 2 * MAX_LINK_SIZE) throw new Error(DAMAGED_LINK);
  let scenario;
  try {
    const bytes = decodeBase64(match[2]);
    const text = match[1] === "z" ? await passThrough(bytes, new DecompressionStream("deflate-raw")) : bytes;
    scenario = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(text));
  } catch (error) {
    throw new Error(DAMAGED_LINK);
  }
  const checked = await request("/check", { scenario }).catch((error) => {
    throw new Error(`link: ${error.message}`);
  });
  return checked.scenario;
}

async function copyLink() {
  try {
    const link = await scenarioLink((await request("/check", { scenario: play.scenario })).scenario);
    history.replaceState(null, "", link);
    const isCopied = await Promise.resolve(navigator.clipboard && navigator.clipboard.writeText(link).then(() => true))
      .catch(() => false);
    play.notice = isCopied ? "Link copied" : "The address of this page is now the link";
  } catch (error) {
    play.error = error.message;
  }
  show();
}

// Loads the scenario of the address; a damaged link is reported in one line and changes nothing.
export async function openLink() {
  const { hash } = location;
  try {
    const scenario = await scenarioOfLink(hash);
    if (scenario === null || hash !== location.hash) return false;
    closeLesson();
    setScenario(scenario);
    history.replaceState(null, "", hash);
    return true;
  } catch (error) {
    play.notice = error.message;
    show();
    return false;
  }
}

byId("link").addEventListener("click", copyLink);
window.addEventListener("hashchange", openLink);
