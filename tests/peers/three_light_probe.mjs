// The light probe of three.js (LightProbeGenerator) in Node: a peer for mr360-bench.
//
// three.js makes a probe of a cube map. The panorama is brought to six square faces a quarter as wide as itself, which is not timed;
// 8-bit frames are then given to fromCubeTexture, which asks for a canvas, and linear floats to fromCubeRenderTarget, which asks for a
// renderer: both are stood in for by what hands over the raw pixels, so that three.js's own code does all the maths.
//
// Speaks lines on stdin and stdout. First it prints three.js's revision. "frame W H" is followed by W*H*3 bytes of sRGB, "radiance W H"
// by W*H*3 little-endian floats, both answered "ok"; "run" estimates once and is answered with its milliseconds; "light" is answered with
// the light as JSON: SH of radiance in the order of l(l+1)+m on (x, y, z) with y up and -z forward, as three.js has them, and no lights.

import { readSync, writeSync } from 'node:fs';
import * as THREE from 'three';
import { LightProbeGenerator } from 'three/addons/lights/LightProbeGenerator.js';

// Samples of the panorama along each side of a face's pixel.
const SAMPLES = 4;

function readExactly( length ) {
	const buffer = Buffer.alloc( length );
	for ( let filled = 0; filled < length; ) {
		const count = readSync( 0, buffer, filled, length - filled );
		if ( count === 0 ) return null;
		filled += count;
	}
	return buffer;
}

function readLine() {
	let line = '';
	for ( ;; ) {
		const byte = readExactly( 1 );
		if ( byte === null ) return null;
		if ( byte[ 0 ] === 10 ) return line;
		line += String.fromCharCode( byte[ 0 ] );
	}
}

// Where three.js takes the pixels of a cube map to lie: (column, row) in [-1, 1], right and up, to a direction. Cube textures are
// left-handed, as OpenGL's are; cube render targets of a WebGL renderer are not.
const TEXTURE = [
	( c, r ) => [ - 1, r, - c ], ( c, r ) => [ 1, r, c ], ( c, r ) => [ - c, 1, - r ],
	( c, r ) => [ - c, - 1, r ], ( c, r ) => [ - c, r, 1 ], ( c, r ) => [ c, r, - 1 ]
];
const TARGET = [
	( c, r ) => [ 1, r, - c ], ( c, r ) => [ - 1, r, c ], ( c, r ) => [ c, 1, - r ],
	( c, r ) => [ c, - 1, r ], ( c, r ) => [ c, r, 1 ], ( c, r ) => [ - c, r, - 1 ]
];

// Six faces of linear RGBA floats: the mean of what lies under each pixel. "linear" holds width * height linear triples.
function cube( linear, width, height, directions ) {
	const side = Math.max( 1, width / 4 | 0 );
	return directions.map( ( directionOf ) => {
		const face = new Float32Array( side * side * 4 );
		for ( let pixel = 0; pixel < side * side; pixel ++ ) {
			for ( let sample = 0; sample < SAMPLES * SAMPLES; sample ++ ) {
				const across = pixel % side + ( sample % SAMPLES + 0.5 ) / SAMPLES;
				const down = Math.floor( pixel / side ) + ( Math.floor( sample / SAMPLES ) + 0.5 ) / SAMPLES;
				const [ x, y, z ] = directionOf( across / side * 2 - 1, 1 - down / side * 2 );
				// Longitude 0 is -z, and grows towards x.
				const u = Math.atan2( x, - z ) / ( 2 * Math.PI ) + 0.5;
				const v = 0.5 - Math.atan2( y, Math.hypot( x, z ) ) / Math.PI;
				const column = Math.min( width - 1, u * width | 0 ), row = Math.min( height - 1, v * height | 0 );
				for ( let channel = 0; channel < 3; channel ++ ) {
					face[ 4 * pixel + channel ] += linear[ 3 * ( row * width + column ) + channel ] / ( SAMPLES * SAMPLES );
				}
			}
			face[ 4 * pixel + 3 ] = 1;
		}
		return face;
	} );
}

// Stands in for the page: a canvas whose context gives back the pixels of the image that is drawn into it.
globalThis.document = {
	createElement: () => ( {
		getContext: () => {
			let drawn = null;
			return { drawImage: ( image ) => { drawn = image; }, getImageData: () => drawn };
		}
	} )
};

function probeOfCodes( codes, width, height ) {
	const color = new THREE.Color();
	const linear = new Float32Array( codes.length );
	for ( let i = 0; i < codes.length; i += 3 ) {
		color.setRGB( codes[ i ] / 255, codes[ i + 1 ] / 255, codes[ i + 2 ] / 255 ).convertSRGBToLinear();
		linear.set( [ color.r, color.g, color.b ], i );
	}
	const images = cube( linear, width, height, TEXTURE ).map( ( face ) => {
		const side = Math.sqrt( face.length / 4 ), data = new Uint8ClampedArray( face.length );
		for ( let i = 0; i < face.length; i += 4 ) {
			color.setRGB( face[ i ], face[ i + 1 ], face[ i + 2 ] ).convertLinearToSRGB();
			data.set( [ Math.round( color.r * 255 ), Math.round( color.g * 255 ), Math.round( color.b * 255 ), 255 ], i );
		}
		return { width: side, height: side, data };
	} );
	const texture = new THREE.CubeTexture( images );
	texture.colorSpace = THREE.SRGBColorSpace;
	return () => LightProbeGenerator.fromCubeTexture( texture );
}

function probeOfRadiance( radiance, width, height ) {
	const faces = cube( radiance, width, height, TARGET );
	const target = { width: Math.sqrt( faces[ 0 ].length / 4 ), texture: { type: THREE.FloatType, colorSpace: THREE.LinearSRGBColorSpace } };
	const renderer = {
		isWebGLRenderer: true,
		coordinateSystem: THREE.WebGLCoordinateSystem,
		readRenderTargetPixelsAsync: ( from, x, y, w, h, buffer, face ) => buffer.set( faces[ face ] )
	};
	return () => LightProbeGenerator.fromCubeRenderTarget( renderer, target );
}

const say = ( text ) => writeSync( 1, `${ text }\n` );
let probe = null, made = null;
say( `three.js r${ THREE.REVISION }` );
for ( let line = readLine(); line !== null; line = readLine() ) {
	const [ what, width, height ] = line.split( ' ' ).map( ( word, at ) => at === 0 ? word : Number( word ) );
	if ( what === 'frame' ) {
		probe = probeOfCodes( readExactly( width * height * 3 ), width, height );
		say( 'ok' );
	} else if ( what === 'radiance' ) {
		const bytes = readExactly( width * height * 12 );
		probe = probeOfRadiance( new Float32Array( bytes.buffer, bytes.byteOffset, width * height * 3 ), width, height );
		say( 'ok' );
	} else if ( what === 'run' ) {
		const started = performance.now();
		made = await probe();
		say( performance.now() - started );
	} else {
		say( JSON.stringify( { sh: made.sh.coefficients.map( ( { x, y, z } ) => [ x, y, z ] ), lights: [] } ) );
	}
}
