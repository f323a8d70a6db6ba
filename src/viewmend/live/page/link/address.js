// Addresses of the server that the page came from.

/**
 * The address of a path of the server, which a proxy may serve under a prefix: relative to this file's own address.
 * @param {string} path @param {string | null} token
 */
export function address(path, token) {
  const url = new URL(`../../${path}`, import.meta.url);
  url.search = token === null ? "" : new URLSearchParams({ token }).toString();
  return url;
}
