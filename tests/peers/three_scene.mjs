// The truth scenes in three.js, as its users would set them up: the panorama as PMREM environment and background, the strongest light of the
// same estimate as a directional light with a shadow map, the ground as a shadow catcher.
//
//     node three_scene.mjs FOLDER_WITH_NODE_MODULES CHROMIUM < jobs.json
//
// jobs.json: [{panorama: .exr, light: what `analyze --json` printed, out: .png, width, height, fov_y_deg, pitch_deg, ground_y,
//   objects: [{shape | model, position, rotation: quaternion, scale, material?: {base_color, roughness, metallic}}]}]
//
// Prints one line a job, `ok` or `failed: why`, after `three.js rNNN, Chromium`. What is made better than the defaults, to judge it at its best:
// the light is taken out of the environment, so that it does not count twice; everything is blended in linear light at half floats and four samples;
// the background is drawn from the panorama itself and not from a cube map. The shadow catcher darkens by the light's share of the ground's irradiance.

import { spawn } from 'node:child_process';
import { readFileSync, writeFileSync, writeSync, mkdtempSync, rmSync, existsSync } from 'node:fs';
import { createServer } from 'node:http';
import { tmpdir } from 'node:os';
import { join, normalize, resolve } from 'node:path';

const PATIENCE_MS = 300_000;

// What runs in the page; it stands by itself.
async function page( jobs ) {
	const THREE = await import( 'three' );
	const { EXRLoader } = await import( 'three/addons/loaders/EXRLoader.js' );
	const { GLTFLoader } = await import( 'three/addons/loaders/GLTFLoader.js' );

	const renderer = new THREE.WebGLRenderer( { antialias: true } );
	renderer.shadowMap.enabled = true;
	renderer.shadowMap.type = THREE.PCFSoftShadowMap;

	// Rows from the top, longitude 0 at the centre looking along -z, to three's rows from the bottom and centre along +x.
	async function panorama( url ) {
		const { image } = await new EXRLoader().setDataType( THREE.FloatType ).loadAsync( url );
		const { width, height, data } = image;
		const channels = data.length / ( width * height );
		const radiance = new Float32Array( width * height * 3 );
		for ( let row = 0; row < height; row ++ ) for ( let column = 0; column < width; column ++ ) for ( let c = 0; c < 3; c ++ ) {
			const value = data[ ( row * width + column ) * channels + c ];
			// The loader's first row is the lowest one.
			radiance[ ( ( height - 1 - row ) * width + column ) * 3 + c ] = value > 0 ? Math.min( value, 65000 ) : 0;
		}
		return { width, height, radiance };
	}

	function direction( { width, height }, row, column ) {
		const longitude = ( ( column + 0.5 ) / width - 0.5 ) * 2 * Math.PI, latitude = ( 0.5 - ( row + 0.5 ) / height ) * Math.PI;
		return new THREE.Vector3( Math.cos( latitude ) * Math.sin( longitude ), Math.sin( latitude ), - Math.cos( latitude ) * Math.cos( longitude ) );
	}

	// What exceeds its surroundings within 1.5 half angles of the light is taken out of the environment.
	function withoutLight( map, light ) {
		const towards = new THREE.Vector3( ...light.direction );
		const half = Math.acos( Math.max( - 1, 1 - light.solid_angle_sr / ( 2 * Math.PI ) ) );
		const radius = Math.max( 1.5 * half, 1.5 * Math.PI / map.height );
		const around = [ 0, 0, 0 ], inside = [];
		let weight = 0;
		for ( let row = 0; row < map.height; row ++ ) for ( let column = 0; column < map.width; column ++ ) {
			const toPixel = direction( map, row, column ), angle = toPixel.angleTo( towards ), at = ( row * map.width + column ) * 3;
			if ( angle < radius ) inside.push( at );
			else if ( angle < 2 * radius ) {
				const area = Math.sqrt( Math.max( 0, 1 - toPixel.y * toPixel.y ) );
				weight += area;
				for ( let c = 0; c < 3; c ++ ) around[ c ] += map.radiance[ at + c ] * area;
			}
		}
		const radiance = map.radiance.slice();
		for ( const at of inside ) for ( let c = 0; c < 3; c ++ ) radiance[ at + c ] = Math.min( radiance[ at + c ], around[ c ] / weight );
		return { ...map, radiance };
	}

	function groundIrradiance( map ) {
		const sum = [ 0, 0, 0 ];
		for ( let row = 0; row < map.height / 2; row ++ ) {
			const latitude = ( 0.5 - ( row + 0.5 ) / map.height ) * Math.PI;
			const weight = Math.sin( latitude ) * Math.cos( latitude ) * ( Math.PI / map.height ) * ( 2 * Math.PI / map.width );
			for ( let column = 0; column < map.width; column ++ ) for ( let c = 0; c < 3; c ++ ) {
				sum[ c ] += map.radiance[ ( row * map.width + column ) * 3 + c ] * weight;
			}
		}
		return sum;
	}

	function texture( map, shift ) {
		const data = new Uint16Array( map.width * map.height * 4 );
		for ( let row = 0; row < map.height; row ++ ) for ( let column = 0; column < map.width; column ++ ) {
			const from = ( ( map.height - 1 - row ) * map.width + ( column + shift + map.width ) % map.width ) * 3, to = ( row * map.width + column ) * 4;
			for ( let c = 0; c < 3; c ++ ) data[ to + c ] = THREE.DataUtils.toHalfFloat( map.radiance[ from + c ] );
			data[ to + 3 ] = THREE.DataUtils.toHalfFloat( 1 );
		}
		const made = new THREE.DataTexture( data, map.width, map.height, THREE.RGBAFormat, THREE.HalfFloatType );
		made.wrapS = THREE.RepeatWrapping;
		made.minFilter = made.magFilter = THREE.LinearFilter;
		made.colorSpace = THREE.LinearSRGBColorSpace;
		made.needsUpdate = true;
		return made;
	}

	function background( map, camera ) {
		const material = new THREE.ShaderMaterial( {
			depthTest: false, depthWrite: false, toneMapped: false,
			uniforms: { map: { value: texture( map, 0 ) }, inverse: { value: camera.projectionMatrixInverse }, world: { value: camera.matrixWorld } },
			vertexShader: 'varying vec2 at; void main() { at = position.xy; gl_Position = vec4( position.xy, 0.5, 1.0 ); }',
			fragmentShader: `uniform sampler2D map; uniform mat4 inverse, world; varying vec2 at;
				void main() {
					vec3 d = normalize( mat3( world ) * ( inverse * vec4( at, 0.5, 1.0 ) ).xyz );
					vec2 uv = vec2( atan( d.x, - d.z ) / 6.283185307 + 0.5, asin( d.y ) / 3.141592654 + 0.5 );
					gl_FragColor = vec4( textureLod( map, uv, 0.0 ).rgb, 1.0 );
				}`
		} );
		const mesh = new THREE.Mesh( new THREE.PlaneGeometry( 2, 2 ), material );
		mesh.frustumCulled = false;
		mesh.renderOrder = - 1;
		return mesh;
	}

	async function made( object ) {
		const surface = object.material && new THREE.MeshStandardMaterial( {
			color: new THREE.Color().setRGB( ...object.material.base_color, THREE.LinearSRGBColorSpace ),
			roughness: object.material.roughness, metalness: object.material.metallic
		} );
		const shapes = { sphere: () => new THREE.SphereGeometry( 0.5, 96, 48 ), cube: () => new THREE.BoxGeometry( 1, 1, 1 ), cylinder: () => new THREE.CylinderGeometry( 0.5, 0.5, 1, 96 ) };
		const node = object.shape ? new THREE.Mesh( shapes[ object.shape ](), surface ) : ( await new GLTFLoader().loadAsync( object.model ) ).scene;
		node.traverse( ( part ) => {
			part.castShadow = part.receiveShadow = true;
			if ( surface && part.isMesh ) part.material = surface;
		} );
		node.position.set( ...object.position );
		node.quaternion.set( ...object.rotation );
		node.scale.set( ...object.scale );
		return node;
	}

	function directional( light, bounds ) {
		const strongest = Math.max( ...light.irradiance );
		const made = new THREE.DirectionalLight( new THREE.Color( ...light.irradiance.map( ( x ) => x / strongest ) ), strongest );
		const middle = bounds.getCenter( new THREE.Vector3() ), radius = bounds.getSize( new THREE.Vector3() ).length() / 2;
		made.position.copy( middle ).addScaledVector( new THREE.Vector3( ...light.direction ), 3 * radius );
		made.target.position.copy( middle );
		Object.assign( made.shadow.camera, { left: - radius, right: radius, top: radius, bottom: - radius, near: radius, far: 8 * radius } );
		made.castShadow = true;
		made.shadow.mapSize.set( 2048, 2048 );
		made.shadow.bias = - 0.0005;
		made.shadow.normalBias = 0.01;
		return made;
	}

	const luminance = ( [ r, g, b ] ) => 0.2126 * r + 0.7152 * g + 0.0722 * b;
	const encode = ( x ) => Math.round( 255 * ( x <= 0.0031308 ? 12.92 * x : 1.055 * Math.min( x, 1 ) ** ( 1 / 2.4 ) - 0.055 ) );

	async function draw( job ) {
		const scene = new THREE.Scene();
		const camera = new THREE.PerspectiveCamera( job.fov_y_deg, job.width / job.height, 0.05, 1000 );
		camera.rotation.x = job.pitch_deg * Math.PI / 180;
		camera.updateMatrixWorld();
		const map = await panorama( job.panorama );
		const light = job.light.lights.toSorted( ( a, b ) => luminance( b.irradiance ) - luminance( a.irradiance ) )[ 0 ];
		const ambient = light ? withoutLight( map, light ) : map;
		const equirect = texture( ambient, map.width / 4 );
		equirect.mapping = THREE.EquirectangularReflectionMapping;
		const pmrem = new THREE.PMREMGenerator( renderer );
		scene.environment = pmrem.fromEquirectangular( equirect ).texture;
		scene.add( background( map, camera ) );
		const bounds = new THREE.Box3();
		for ( const object of job.objects ) {
			const node = await made( object );
			scene.add( node );
			bounds.expandByObject( node );
		}
		if ( light && light.direction[ 1 ] > 0 ) {
			const sun = directional( light, bounds );
			scene.add( sun, sun.target );
			const direct = luminance( light.irradiance ) * light.direction[ 1 ];
			const catcher = new THREE.Mesh( new THREE.PlaneGeometry( 200, 200 ), new THREE.ShadowMaterial( { opacity: direct / ( direct + luminance( groundIrradiance( ambient ) ) ) } ) );
			catcher.rotation.x = - Math.PI / 2;
			catcher.position.y = job.ground_y;
			catcher.receiveShadow = true;
			scene.add( catcher );
		}
		const target = new THREE.WebGLRenderTarget( job.width, job.height, { type: THREE.HalfFloatType, samples: 4 } );
		renderer.setRenderTarget( target );
		renderer.render( scene, camera );
		const half = new Uint16Array( job.width * job.height * 4 );
		renderer.readRenderTargetPixels( target, 0, 0, job.width, job.height, half );
		const canvas = new OffscreenCanvas( job.width, job.height ), context = canvas.getContext( '2d' );
		const picture = context.createImageData( job.width, job.height );
		for ( let row = 0; row < job.height; row ++ ) for ( let i = 0; i < job.width * 4; i ++ ) {
			const value = THREE.DataUtils.fromHalfFloat( half[ ( job.height - 1 - row ) * job.width * 4 + i ] );
			picture.data[ row * job.width * 4 + i ] = i % 4 === 3 ? 255 : encode( Math.max( 0, value ) );
		}
		context.putImageData( picture, 0, 0 );
		return canvas.convertToBlob( { type: 'image/png' } );
	}

	await fetch( '/begun', { method: 'POST', body: THREE.REVISION } );
	for ( const [ at, job ] of jobs.entries() ) {
		try {
			await fetch( `/done/${ at }`, { method: 'POST', body: await draw( job ) } );
		} catch ( error ) {
			await fetch( `/failed/${ at }`, { method: 'POST', body: `${ error.stack ?? error }` } );
		}
	}
	await fetch( '/end', { method: 'POST' } );
}

const say = ( text ) => writeSync( 1, `${ text.replaceAll( '\n', ' ' ) }\n` );
const [ folder, chromium ] = process.argv.slice( - 2 );
const jobs = JSON.parse( readFileSync( 0, 'utf8' ) );
const three = join( resolve( folder ), 'node_modules', 'three' );
if ( ! existsSync( three ) ) throw new Error( `${ folder }: holds no three; run \`npm install three\` in it` );
// The page may ask for what the jobs name, by number, and for three.js.
const files = [];
const served = ( path ) => `/file/${ files.push( resolve( path ) ) - 1 }`;
const asked = jobs.map( ( job ) => ( {
	...job,
	panorama: served( job.panorama ),
	light: JSON.parse( readFileSync( job.light, 'utf8' ).split( '\n' )[ 0 ] ),
	objects: job.objects.map( ( object ) => object.model ? { ...object, model: served( object.model ) } : object )
} ) );
const imports = JSON.stringify( { imports: { three: '/three/build/three.module.js', 'three/addons/': '/three/examples/jsm/' } } );
const html = `<!doctype html><script type="importmap">${ imports }</script><script type="module">${ page };
	page( ${ JSON.stringify( asked ) } ).catch( ( error ) => fetch( '/broken', { method: 'POST', body: String( error.stack ?? error ) } ) );</script>`;

const profile = mkdtempSync( join( tmpdir(), 'mr360-three-' ) );
let browser = null;
function leave( code ) {
	if ( browser ) browser.once( 'exit', () => { rmSync( profile, { recursive: true, force: true, maxRetries: 5 } ); process.exit( code ); } ).kill( 'SIGKILL' );
	else process.exit( code );
}

const server = createServer( async ( request, response ) => {
	const [ , what, ...rest ] = decodeURIComponent( new URL( request.url, 'http://page' ).pathname ).split( '/' );
	if ( request.method === 'POST' ) {
		const parts = [];
		for await ( const part of request ) parts.push( part );
		const body = Buffer.concat( parts );
		if ( what === 'begun' ) say( `three.js r${ body }, Chromium` );
		if ( what === 'done' ) { writeFileSync( jobs[ Number( rest[ 0 ] ) ].out, body ); say( 'ok' ); }
		if ( what === 'failed' || what === 'broken' ) say( `failed: ${ body }` );
		response.end();
		if ( what === 'end' || what === 'broken' ) leave( what === 'end' ? 0 : 1 );
		return;
	}
	try {
		const types = { '': 'text/html', three: 'text/javascript', file: 'application/octet-stream' };
		response.setHeader( 'content-type', types[ what ] ?? 'text/plain' );
		if ( what === '' ) response.end( html );
		else if ( what === 'three' ) response.end( readFileSync( join( three, normalize( `/${ rest.join( '/' ) }` ) ) ) );
		else if ( what === 'file' ) response.end( readFileSync( files[ Number( rest[ 0 ] ) ] ) );
		else response.writeHead( 404 ).end();
	} catch ( error ) {
		response.writeHead( 404 ).end( String( error ) );
	}
} );
server.listen( 0, '127.0.0.1', () => {
	const flags = [ '--headless=new', '--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--disable-gpu-sandbox', `--user-data-dir=${ profile }` ];
	browser = spawn( chromium, [ ...flags, `http://127.0.0.1:${ server.address().port }/` ], { stdio: 'ignore' } );
	browser.on( 'error', ( error ) => { say( `failed: ${ chromium }: ${ error.message }` ); process.exit( 1 ); } );
	setTimeout( () => { say( 'failed: the browser said nothing for too long' ); leave( 1 ); }, PATIENCE_MS * Math.max( 1, jobs.length ) ).unref();
} );
