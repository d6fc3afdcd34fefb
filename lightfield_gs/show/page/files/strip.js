// Views that were drawn beforehand, from the left-most camera's on: {width, height, frames}, frames as data URLs.

/** Decodes the views, and returns a function that shows the one at a place, 0..1 from the left, and returns its number. */
export async function stripOf(canvas, { width, height, frames }) {
  const images = await Promise.all(frames.map(async (src) => {
    const image = Object.assign(new Image(), { src });
    await image.decode();
    return image;
  }));
  Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  return (place) => {
    const number = Math.round(Math.min(1, Math.max(0, place)) * (images.length - 1));
    context.drawImage(images[number], 0, 0);
    canvas.dataset.view = number;
    return number;
  };
}
