// URLs of the server that the page came from.

/**
 * Build the URL of a path of the server. A proxy may serve the page under a prefix, so the URL is relative to
 * this file's own.
 * @param {string} path
 * @param {string | null} token
 */
export function buildAddress(path, token) {
  const url = new URL(`../../${path}`, import.meta.url);
  url.search = token === null ? "" : new URLSearchParams({ token }).toString();
  return url;
}
